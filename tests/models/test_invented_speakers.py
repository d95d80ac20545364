"""Invented speakers: motion and reference get the same gains, in training only, under a hidden identity."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from facediff.data import Batch, collate
from facediff.models import DualPathDiffusion, load_model
from facediff.models.invented_speakers import COMPONENTS, InventedSpeakers
from tests.fakes.tiny import Tiny

VERTICES, SCALE = 40, 25.0
Make = Callable[..., Any]


def invented(share: float, deviation: float) -> InventedSpeakers:
    """With components of some correlated motion, under weights."""
    made = InventedSpeakers(VERTICES, 3, share, deviation)
    random = torch.Generator().manual_seed(1)
    weights = 1 + torch.rand(3 * VERTICES, generator=random)
    mixed = torch.randn(300, 90, generator=random) @ torch.randn(90, 3 * VERTICES, generator=random)
    _, sizes, shapes = torch.linalg.svd((mixed - mixed.mean(0)) * weights, full_matrices=False)
    made.components.attach(mixed.mean(0), sizes[:, None] * shapes / 300**0.5, weights)
    return made


def batch(clips: int = 6) -> Batch:
    random = torch.Generator().manual_seed(2)
    return Batch(
        audio=torch.zeros(clips, 640 * 9),
        audio_lengths=torch.full((clips,), 640 * 9),
        motion=torch.randn(clips, 9, VERTICES, 3, generator=random),
        frame_lengths=torch.full((clips,), 9),
        template=torch.zeros(clips, VERTICES, 3),
        identity=torch.arange(clips),
        reference=torch.randn(clips, 7, VERTICES, 3, generator=random),
        reference_lengths=torch.full((clips,), 7),
        names=[f"S{i}_e01" for i in range(clips)],
        identity_names=[f"S{i}" for i in range(clips)],
        sentences=["e01"] * clips,
        reference_names=["S0_e02"] * clips,
    )


def test_motion_and_reference_get_the_same_gains() -> None:
    torch.manual_seed(0)
    made, given = invented(1.0, 0.3), batch(40)
    after = made(given, SCALE)
    part = made.components
    mean, basis, weights = (each.double().numpy() for each in (part.mean, part.basis, part.weights))
    logs = []
    for row in range(40):
        gains = []
        for name in ("motion", "reference"):
            old, new = (
                (getattr(b, name)[row].flatten(1).double().numpy() * SCALE - mean) * weights for b in (given, after)
            )
            before, inside = old @ basis.T, new @ basis.T
            gain = (inside * before).sum(0) / np.square(before).sum(0)
            np.testing.assert_allclose(inside, gain * before, atol=1e-3)
            rest, outside = old - before @ basis, new - inside @ basis
            common = (outside * rest).sum() / np.square(rest).sum()
            np.testing.assert_allclose(outside, common * rest, atol=1e-3)
            gains.append(np.log([common, *gain]))
        np.testing.assert_allclose(gains[0], gains[1], atol=2e-3)
        logs.append(gains[0])
    found = np.array(logs)
    assert found[:, 0].std() == pytest.approx(0.3, rel=0.35)
    assert (found[:, 1:] - found[:, :1]).std() == pytest.approx(0.15, rel=0.1)
    assert found.shape[1] == 1 + COMPONENTS
    assert after.identity.tolist() == [-1] * 40
    assert len(set(after.identity_names)) == 40
    assert not set(after.identity_names) & set(given.identity_names)


def test_only_a_share_of_the_clips_is_changed_and_none_in_place() -> None:
    torch.manual_seed(0)
    given = batch(200)
    copies = given.motion.clone(), given.reference.clone(), given.identity.clone()
    after = invented(0.3, 0.1)(given, SCALE)
    for copy, kept in zip(copies, (given.motion, given.reference, given.identity), strict=True):
        assert torch.equal(copy, kept)
    hidden = after.identity == -1
    assert 0.2 < float(hidden.float().mean()) < 0.4
    for row, new in enumerate(hidden.tolist()):
        assert torch.equal(given.motion[row], after.motion[row]) != new
        assert torch.equal(given.reference[row], after.reference[row]) != new
        assert (after.identity_names[row] == given.identity_names[row]) != new


def test_a_model_invents_in_training_alone(
    make_model: Make,
    make_trainer: Callable[..., pl.Trainer],
    tiny: Tiny,
    tmp_path: Path,
) -> None:
    model = make_model(invented_speakers=1.0, identity_dropout=0.0)
    trainer = make_trainer(max_steps=2, limit_val_batches=1)
    seen: dict[bool, list[int]] = {True: [], False: []}
    at = model.losses_at

    def watch(batch: Batch, *inputs: torch.Tensor) -> dict[str, torch.Tensor]:
        seen[model.training].extend(batch.identity.tolist())
        result: dict[str, torch.Tensor] = at(batch, *inputs)
        return result

    model.losses_at = watch
    trainer.fit(model, datamodule=tiny)
    model.eval().losses(collate([tiny.dataset("train")[0]]))
    assert set(seen[True]) == {-1}
    assert seen[False]
    assert -1 not in seen[False]
    del model.losses_at
    trainer.save_checkpoint(tmp_path / "model.ckpt")
    loaded = load_model(tmp_path / "model.ckpt")
    assert isinstance(loaded, DualPathDiffusion)
    clip = collate([tiny.dataset("test_a")[0]])
    torch.testing.assert_close(loaded.generate(clip, seed=1), model.eval().generate(clip, seed=1))
