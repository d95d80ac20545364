"""The function that is made from each metric's class, the written-out signatures, and the names in the registry."""

from __future__ import annotations

import inspect
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

import facediff.metrics as fm
from facediff import registry
from facediff.metrics import Clip, LipMetric, functional

NAMES = registry.metric.names()


class LipLag(LipMetric):
    """Lip lag: a metric for this test.

    Args:
        lips: The lips.
        power: A power.
    """

    words = "power of the mean distance over {region} [1]"

    def __init__(self, lips: Any, *, power: float = 2.0, **options: Any) -> None:  # noqa: ANN401
        super().__init__(lips, **options)
        self.power = power

    def clip_value(self, clip: Clip) -> Tensor:
        gap = (clip.prediction - clip.truth).index_select(1, self.indices).double()
        return gap.norm(dim=-1).mean() ** self.power


def test_every_metric_has_a_function_of_its_name() -> None:
    assert len(NAMES) >= 25
    for name in NAMES:
        function, implementation = getattr(fm, name), registry.metric.get(name)
        assert (function.__name__, function.__module__) == (name, implementation.__module__)
        assert implementation is getattr(fm, implementation.__name__)


@pytest.mark.parametrize("name", NAMES)
def test_the_signature_names_every_argument(name: str) -> None:
    signature = inspect.signature(getattr(fm, name))
    assert not any(p.kind is inspect.Parameter.VAR_KEYWORD for p in signature.parameters.values())
    assert not {"check_finite", "sync_on_compute", "definition"} & signature.parameters.keys()


def test_options_that_all_metrics_share_are_written_out() -> None:
    options = inspect.signature(fm.LipVertexError).parameters
    assert list(options)[:3] == ["lips", "squared", "pooling"]
    assert options["length_rule"].default == "min"
    assert options["check_finite"].default is True
    assert "lengths" in inspect.signature(fm.FaceDynamicsDeviation.update).parameters
    assert "prediction" not in inspect.signature(fm.SampleDiversity.update).parameters


def test_a_class_of_ones_own_becomes_a_function() -> None:
    lag = functional(LipLag)
    assert lag.__name__ == "lip_lag"
    assert list(inspect.signature(lag).parameters)[:3] == ["prediction", "truth", "lips"]
    prediction, truth = torch.ones(2, 5, 3, 3), torch.zeros(2, 5, 3, 3)
    assert lag(prediction, truth, [0, 1], power=4.0).item() == pytest.approx(9.0)
    assert lag(prediction, truth, [0], lengths=[2, 1]).item() == pytest.approx(3.0)
    with pytest.raises(TypeError):
        lag(prediction, truth, [0], strength=1.0)
    with pytest.raises(ValueError, match="holds NaN"):
        lag(prediction * torch.nan, truth, [0])
    assert LipLag([0, 2]).describe() == f"power of the mean distance over {LipLag([0, 2]).region} [1]"


def test_arrays_may_be_backwards_or_of_the_other_order_of_bytes() -> None:
    motion = np.random.default_rng(0).random((5, 4, 3), np.float32)
    expected = fm.lip_vertex_error(motion[::-1].copy(), motion, [0])
    assert fm.lip_vertex_error(motion[::-1], motion.astype(">f4"), [0]) == expected > 0
