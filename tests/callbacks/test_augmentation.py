"""Invented speakers: motion and reference get the same gains, in training only, under a hidden identity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from facediff.callbacks import InventedSpeakers
from facediff.data import Batch, collate
from facediff.errors import FaceDiffError
from tests.fakes.tiny import Tiny


def copied(batch: Batch) -> Batch:
    return replace(
        batch, motion=batch.motion.clone(), reference=batch.reference.clone(), identity=batch.identity.clone()
    )


@pytest.fixture
def fitted(make_model: Callable[..., Any], make_trainer: Callable[..., pl.Trainer], tiny: Tiny) -> Callable[..., Any]:
    """Fits a model, and gives the batches that its training steps saw with those that the loader gave."""

    def fit(**options: float) -> tuple[list[Batch], list[Batch], InventedSpeakers]:
        callback, given, seen = InventedSpeakers(count=1, **options), [], []

        class Watch(pl.Callback):
            def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Batch, batch_idx: int) -> None:  # noqa: ANN401
                given.append(copied(batch))

        model = make_model()
        step = model.training_step

        def training_step(batch: Batch, batch_idx: int) -> torch.Tensor:
            seen.append(copied(batch))
            result: torch.Tensor = step(batch, batch_idx)
            return result

        model.training_step = training_step
        make_trainer(max_epochs=2, callbacks=[Watch(), callback]).fit(model, datamodule=tiny)
        return given, seen, callback

    return fit


def test_motion_and_reference_get_the_same_gains(fitted: Callable[..., Any], tiny: Tiny) -> None:
    given, seen, _ = fitted(share=1.0, deviation=0.3, component_deviation=0.2)
    mean, shapes = (part.double().numpy() for part in tiny.principal_motion(1))
    unit = shapes / np.linalg.norm(shapes, axis=1, keepdims=True)
    found = []
    for before, after in zip(given, seen, strict=True):
        assert (after.identity == -1).all()
        for row in range(len(before)):
            gains = []
            for name in ("motion", "reference"):
                length = int(getattr(before, "frame_lengths" if name == "motion" else "reference_lengths")[row])
                old, new = (getattr(b, name)[row, :length].flatten(1).double().numpy() - mean for b in (before, after))
                # The part inside the components by their gains, the part outside by the common one alone.
                inside, outside = new @ unit.T, new - new @ unit.T @ unit
                gain = (inside * (old @ unit.T)).sum(0) / np.square(old @ unit.T).sum(0)
                np.testing.assert_allclose(inside, gain * (old @ unit.T), atol=1e-4 * np.abs(inside).max())
                rest = old - old @ unit.T @ unit
                common = (outside * rest).sum() / np.square(rest).sum()
                np.testing.assert_allclose(outside, common * rest, atol=1e-4 * np.abs(new).max())
                gains.append([*gain, common])
            np.testing.assert_allclose(gains[0], gains[1], rtol=1e-2)
            found.append(gains[0])
    logs = np.log(np.array(found))
    assert logs[:, -1].std() == pytest.approx(0.3, rel=0.5)
    assert (logs[:, :-1] - logs[:, -1:]).std() == pytest.approx(0.2, rel=0.3)


def test_the_other_clips_stay_as_they_are(fitted: Callable[..., Any]) -> None:
    given, seen, _ = fitted(share=0.5)
    hidden = 0
    for before, after in zip(given, seen, strict=True):
        for row in range(len(before)):
            invented = int(after.identity[row]) == -1
            hidden += invented
            assert torch.equal(before.motion[row], after.motion[row]) != invented
            assert torch.equal(before.reference[row], after.reference[row]) != invented
    assert 0.2 < hidden / sum(map(len, given)) < 0.8


def test_validation_and_the_corpus_are_not_touched(fitted: Callable[..., Any], tiny: Tiny) -> None:
    before = collate([tiny.dataset("train")[0], tiny.dataset("val")[0]])
    fitted(share=1.0)
    after = collate([tiny.dataset("train")[0], tiny.dataset("val")[0]])
    assert torch.equal(before.motion, after.motion)


@pytest.mark.parametrize("options", [{"share": 1.5}, {"deviation": -0.1}, {"count": 0}])
def test_impossible_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(FaceDiffError, match=next(iter(options))):
        InventedSpeakers(**options)
