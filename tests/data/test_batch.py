"""Batches and the assets of a checkpoint."""

from __future__ import annotations

from pathlib import Path

import torch

from facediff.data import collate
from tests.fakes.tiny import Tiny


def test_a_batch_pads_with_zeros_and_says_what_is_valid(tiny: Tiny) -> None:
    samples = [tiny.dataset("train")[i] for i in (0, 5)]
    batch = collate(samples)
    assert batch.mask.sum(1).tolist() == [len(s.motion) for s in samples]
    assert batch.reference_mask.sum(1).tolist() == [len(s.reference) for s in samples]
    for i, sample in enumerate(samples):
        assert torch.equal(batch.motion[i, : len(sample.motion)], sample.motion)
        assert not batch.motion[i, len(sample.motion) :].any()
        assert not batch.audio[i, len(sample.audio) :].any()


def test_assets_survive_a_round_trip_through_a_safe_file(tiny: Tiny, tmp_path: Path) -> None:
    from facediff.data import Assets

    assets = tiny.assets().with_motion_scale(3.0)
    torch.save(assets.state(), tmp_path / "assets.pt")
    loaded = Assets.from_state(torch.load(tmp_path / "assets.pt", weights_only=True))
    assert loaded.identities == ["A", "B"]
    assert loaded.motion_scale == 3.0
    assert loaded.references["C"].clip == assets.references["C"].clip
    assert torch.equal(loaded.templates["B"], assets.templates["B"])
    assert loaded.regions["lips"].tolist() == list(range(12))
    assert loaded.faces is not None
    assert loaded.faces.shape == (15, 3)
