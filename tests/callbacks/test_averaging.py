"""The moving average of the weights: against its formula, and what it forgets."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import numpy as np
import pytest
import torch

from facediff.callbacks import EmaWithWarmup
from facediff.errors import FaceDiffError


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


def test_the_first_weights_are_forgotten_in_a_short_training() -> None:
    """With a constant decay of 0.999 they would keep 0.9989 of the average here, and a tenth after 2 350 steps."""
    weights = np.zeros((100, 3), np.float32)
    weights[:10] = 1.0
    assert averages(weights)[-1].max() < 1e-6
    assert averages(weights, warmup=1.0)[-1].min() > 0.9


def test_the_average_follows_a_line_at_a_tenth_of_the_steps() -> None:
    """Weights that grow evenly: the average of n steps lies n / 10 steps behind, until the largest decay is reached."""
    weights = np.repeat(np.arange(1000, dtype=np.float32)[:, None], 3, 1)
    found = averages(weights)[:, 0]
    np.testing.assert_allclose(found[[499, 999]], [450, 900], rtol=0.01)


@pytest.mark.parametrize("wrong", [{"decay": 1.5}, {"decay": "much"}, {"warmup": 0.5}])
def test_a_wrong_option_is_named(wrong: dict[str, Any]) -> None:
    with pytest.raises(FaceDiffError, match=f"EmaWithWarmup.{next(iter(wrong))}"):
        EmaWithWarmup(**wrong)
