"""The moving average of the weights: against its formula, and what it forgets."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint, StochasticWeightAveraging

from facediff.callbacks import EmaWithWarmup
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from tests.fakes.fixtures import quiet_trainer
from tests.fakes.tiny import Tiny


class Weights(pl.LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.zeros(3))
        self.register_buffer("constant", torch.zeros(2))


def averages(weights: np.ndarray, **options: float) -> np.ndarray:
    """The averages after each of the optimiser steps that gave these weights (steps, 3)."""
    model, callback, found = Weights(), EmaWithWarmup(**options), []
    trainer: Any = SimpleNamespace(global_step=0)
    callback.setup(trainer, model, "fit")
    for step, values in enumerate(weights, start=1):
        trainer.global_step = step
        with torch.no_grad():
            model.weight.copy_(torch.from_numpy(values))
            model.constant.fill_(step)
        callback.on_train_batch_end(trainer, model, None, None, step - 1)
        average: Any = callback._average_model
        assert average.module.constant.tolist() == [step, step]  # taken over, not averaged
        found.append(average.module.weight.detach().numpy().copy())
    return np.array(found)


@pytest.mark.parametrize(("decay", "warmup"), [(0.5, 10.0), (0.95, 10.0), (0.9, 3.0), (0.9, 1.0)])
def test_the_average_is_that_of_the_formula(decay: float, warmup: float) -> None:
    weights = np.random.default_rng(0).normal(size=(60, 3)).astype(np.float32)
    expected = [weights[0].astype(np.float64)]
    for k in range(1, len(weights)):
        d = min(decay, (1 + k) / (warmup + k))
        expected.append(d * expected[-1] + (1 - d) * weights[k])
    np.testing.assert_allclose(averages(weights, decay=decay, warmup=warmup), np.array(expected), rtol=1e-5, atol=1e-6)


def test_a_second_average_is_refused_since_checkpoints_have_one() -> None:
    callback = EmaWithWarmup()
    trainer: Any = SimpleNamespace(callbacks=[callback, StochasticWeightAveraging(swa_lrs=0.1)])
    with pytest.raises(FaceDiffError, match="EmaWithWarmup and StochasticWeightAveraging"):
        callback.setup(trainer, Weights(), "fit")


def test_the_first_weights_are_forgotten_in_a_short_training() -> None:
    """With a constant decay of 0.999 they would keep 0.9989 of the average here, and a tenth after 2 350 steps."""
    weights = np.zeros((100, 3), np.float32)
    weights[:10] = 1.0
    assert averages(weights)[-1].max() < 1e-6
    assert averages(weights, warmup=1.0)[-1].min() > 0.9


def test_scores_of_a_checkpoint_by_path_are_those_of_the_average(
    make_model: Callable[..., DualPathDiffusion], tiny: Tiny, tmp_path: Path
) -> None:
    """After ``fit`` with the same trainer, as users of Lightning write it."""
    few: dict[str, Any] = {f"limit_{part}_batches": 1 for part in ("val", "test", "predict")}
    best = ModelCheckpoint(tmp_path, monitor="val/loss")
    callbacks = [EmaWithWarmup(decay=0.9), best]
    trainer = quiet_trainer(tmp_path, max_epochs=2, callbacks=callbacks, enable_checkpointing=True, **few)
    model = make_model()
    trainer.fit(model, datamodule=tiny)
    average = torch.load(best.best_model_path, weights_only=True)["state_dict"]
    raw = torch.load(best.best_model_path, weights_only=True)["current_model_state"]
    assert any(not torch.equal(raw[name], value) for name, value in average.items())
    for scored in (trainer.test, trainer.validate, trainer.predict):
        for path in ("best", best.best_model_path):
            with torch.no_grad():
                model.network.unembed.weight.zero_()
            scored(model, datamodule=tiny, ckpt_path=path)
            assert all(torch.equal(model.state_dict()[name], value) for name, value in average.items()), scored
    trainer.save_checkpoint(tmp_path / "best.ckpt")
    saved = torch.load(tmp_path / "best.ckpt", weights_only=True)["state_dict"]
    assert all(torch.equal(saved[name], value) for name, value in average.items())


def test_a_stopped_validation_leaves_the_trained_weights(
    make_model: Callable[..., DualPathDiffusion], tiny: Tiny, tmp_path: Path
) -> None:
    callback = EmaWithWarmup(decay=0.5)
    trainer = quiet_trainer(tmp_path, callbacks=[callback], limit_val_batches=1)
    model = make_model()
    model.validation_step = lambda *_: 1 // 0  # type: ignore[method-assign, assignment]
    with pytest.raises(ZeroDivisionError):
        trainer.fit(model, datamodule=tiny)
    assert not callback._swapped
