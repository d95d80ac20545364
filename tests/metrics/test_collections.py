"""Metrics of one's own in a collection: merged where all arguments of their constructors are equal, and never else."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor
from torchmetrics import MetricCollection

from facediff.metrics import MeanVertexError
from facediff.metrics.base import Clip, SequenceMetric


@dataclass(frozen=True)
class Scale:
    factor: float


class Scaled(SequenceMetric):
    """Distances times a factor, however that is stated."""

    words = "mean distance times a factor"

    def __init__(self, factor: Any = 1.0, *, note: Any = None, **options: Any) -> None:  # noqa: ANN401
        super().__init__(**options)
        self.factor = factor

    def clip_value(self, clip: Clip) -> Tensor:
        factor = self.factor.factor if isinstance(self.factor, Scale) else self.factor
        factor = factor() if callable(factor) else factor["by"] if isinstance(factor, dict) else factor
        return torch.as_tensor(factor).double().mean() * (clip.prediction - clip.truth).double().norm(dim=-1).mean()


STILL, MOVED = torch.zeros(1, 9, 12, 3), torch.ones(1, 9, 12, 3)
FACTORS = {
    "number": (1.0, 1000.0),
    "tensor": (torch.ones(3), torch.full((3,), 1000.0)),
    "dataclass": (Scale(1.0), Scale(1000.0)),
    "function": (lambda: 1.0, lambda: 1000.0),
    "mapping": ({"by": 1.0}, {"by": 1000.0}),
}


def scores(collection: MetricCollection) -> dict[str, float]:
    collection.update(STILL, STILL)  # perfect, so that all states are equal
    collection.update(MOVED, STILL)
    return {name: float(value) for name, value in collection.compute().items()}


@pytest.mark.parametrize("kind", FACTORS)
def test_metrics_that_differ_in_an_argument_are_not_merged(kind: str) -> None:
    one, thousand = FACTORS[kind]
    found = scores(MetricCollection({"m": Scaled(one), "mm": Scaled(factor=thousand)}))
    assert found["mm"] == pytest.approx(1000 * found["m"])
    assert found["m"] == pytest.approx(3**0.5 / 2)


@pytest.mark.parametrize("options", [{"note": Path("a")}, {"check_finite": False}, {"length_rule": "error"}])
def test_any_argument_counts(options: dict[str, Any]) -> None:
    collection = MetricCollection({"a": Scaled(), "b": Scaled(**options)})
    scores(collection)
    assert len(collection.compute_groups) == 2


def test_metrics_with_equal_arguments_are_merged() -> None:
    pairs = [
        (Scaled(), Scaled(1.0)),
        (Scaled(torch.ones(2)), Scaled(factor=torch.ones(2))),
        (Scaled(Scale(2)), Scaled(Scale(2))),
    ]
    for first, second in [*pairs, (MeanVertexError(), MeanVertexError()), (Scaled(), Scaled().clone())]:
        collection = MetricCollection({"a": first, "b": second})
        scores(collection)
        assert len(collection.compute_groups) == 1
