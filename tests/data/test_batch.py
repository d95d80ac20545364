"""Batches and the assets of a checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from facediff.animation import Animation
from facediff.data import Assets, collate
from facediff.errors import FaceDiffError
from facediff.export import write_animations
from facediff.pipelines.trained import facts_of
from tests.fakes.channels import CHANNELS, TinyChannels, write_channels
from tests.fakes.glb_reader import Reader
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


def test_speakers_take_their_own_colours_through_a_checkpoint_into_exports(tiny: Tiny, tmp_path: Path) -> None:
    with np.load(Path(tiny.root) / "colours.npz") as stored:
        own = dict(stored)
    torch.save(tiny.assets().state(), tmp_path / "assets.pt")
    state = torch.load(tmp_path / "assets.pt", weights_only=True)
    assets = Assets.from_state(state)
    assert assets.identity_colours["B"].dtype == torch.uint8
    facts = facts_of(assets, "B")
    assert np.array_equal(facts["colours"], own["B"])
    assert facts_of(assets, "C")["colours"] is None  # without own colours those of the mesh file, which has none here
    animation = Animation(name="b", vertices=facts["template"][None], **facts)
    for suffix in (".glb", ".ply"):
        write_animations(tmp_path / f"b{suffix}", [animation])
    reader = Reader(tmp_path / "b.glb")
    share = own["B"] / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # IEC 61966-2-1
    np.testing.assert_allclose(reader.values(reader.primitive.attributes.COLOR_0), linear, atol=1e-6)
    mesh = trimesh.load(tmp_path / "b_ply" / "b_0000.ply", process=False)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], own["B"])
    # Checkpoints that were written before speakers had colours have no such entry.
    del state["identity_colours"]
    assert facts_of(Assets.from_state(state), "B")["colours"] is None


def test_assets_of_channels_survive_a_checkpoint_and_refuse_what_does_not_fit(tmp_path: Path) -> None:
    assets = TinyChannels(root=str(write_channels(tmp_path / "channels"))).assets()
    state = assets.state()
    again = Assets.from_state(state)
    assert again.space == CHANNELS
    motion = torch.randn(4, 6, 1)
    assert torch.equal(again.to_scored(motion, "A"), assets.to_scored(motion, "A"))
    # A speaker without shapes of their own moves by the mean of all others'.
    assert torch.equal(again.to_scored(motion, "stranger"), assets.to_scored(motion, "A"))
    rig = state["rig"]
    wrong = [
        {"space": CHANNELS.state() | {"channels": ["a"], "rotations": []}},
        {"rig": {**rig, "deltas": {"A": torch.zeros(2, 24, 3)}}},
        {"rig": {**rig, "mesh": state}},
        {"identities": ["../A"]},
        {"frame_rate": 0.0},
        {"templates": {"A": torch.full((6, 1), torch.nan)}},
        {"regions": {"lips": torch.tensor([6])}},
    ]
    for change in wrong:
        with pytest.raises(FaceDiffError):
            Assets.from_state({**state, **change})


def test_channels_without_a_rig_have_no_mesh(tmp_path: Path) -> None:
    assets = replace(TinyChannels(root=str(write_channels(tmp_path / "channels"))).assets(), rig=None)
    with pytest.raises(FaceDiffError, match="rig"):
        _ = assets.mesh
    assert Assets.from_state(assets.state()).rig is None
