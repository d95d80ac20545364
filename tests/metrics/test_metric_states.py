"""States: reset, pickling, moves, forward, collections, and the empty metric."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torchmetrics import MetricCollection

from facediff.metrics import Coverage, FaceDynamicsDeviation, LipVertexError, MeanVertexError, SequenceMetric


def metrics() -> list[SequenceMetric]:
    return [MeanVertexError(), LipVertexError([0, 1]), FaceDynamicsDeviation([1, 2])]


def motion(seed: int, frames: int = 6) -> torch.Tensor:
    return torch.randn(2, frames, 4, 3, generator=torch.manual_seed(seed))


@pytest.mark.parametrize("metric", metrics())
def test_forward_gives_the_batch_and_adds_to_the_whole(metric: SequenceMetric) -> None:
    first, second = metric(motion(0), motion(1)), metric(motion(2, 3), motion(3, 3))
    assert metric.coverage() == Coverage(18, 4, 0, 0)
    weight = 0.5 if metric.pooling == "sequences" else 2 / 3
    torch.testing.assert_close(metric.compute(), weight * first + (1 - weight) * second)


@pytest.mark.parametrize("convert", [lambda m: m.half(), lambda m: m.to(torch.bfloat16), lambda m: m.float()])
def test_sums_stay_in_float64_when_the_model_is_converted(
    convert: Callable[[torch.nn.Module], torch.nn.Module],
) -> None:
    held = metrics()
    module = torch.nn.ModuleList([torch.nn.Linear(1, 1), *held])
    for metric in held:
        metric.update(motion(0), motion(1))
    values = [metric.compute().item() for metric in held]
    convert(module)
    for metric, value in zip(held, values, strict=True):
        assert metric.total.dtype == torch.float64
        assert metric.counts.dtype == torch.int64
        assert metric.compute().item() == value
        metric.reset()
        assert metric.total.dtype == torch.float64


def test_a_collection_does_not_take_different_definitions_for_one() -> None:
    # Both signs agree after the first batch, which is when torchmetrics looks for metrics to merge.
    still, lively = torch.zeros(1, 6, 4, 3), motion(0)[:1]
    collection = MetricCollection(
        {
            "signed": FaceDynamicsDeviation([0], sign="signed"),
            "absolute": FaceDynamicsDeviation([0], sign="absolute"),
            "again": FaceDynamicsDeviation([0], sign="absolute"),
            "mve": MeanVertexError(),
        }
    )
    collection.update(still, lively, template=None)
    collection.update(lively, still, template=None)
    values = collection.compute()
    assert values["signed"].item() == 0.0
    assert values["absolute"].item() > 0
    assert values["again"] == values["absolute"]
