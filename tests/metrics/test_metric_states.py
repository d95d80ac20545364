"""States: reset, pickling, moves, forward, collections, and the empty metric."""

from __future__ import annotations

import copy
import pickle
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
def test_reset_and_pickle(metric: SequenceMetric) -> None:
    metric.update(motion(0), motion(1))
    value = metric.compute()
    for twin in (pickle.loads(pickle.dumps(metric)), copy.deepcopy(metric)):  # noqa: S301
        assert twin.compute() == value
        twin.update(motion(2), motion(3))
        assert twin.compute() != value
        assert twin.coverage().sequences == 4
    metric.reset()
    assert metric.coverage() == Coverage(0, 0, 0, 0)


@pytest.mark.parametrize("metric", metrics())
def test_memory_is_constant(metric: SequenceMetric) -> None:
    sizes = set()
    for seed in range(3):
        metric.update(motion(seed), motion(seed + 9))
        sizes.add(sum(len(torch.as_tensor(state).flatten()) for state in metric.metric_state.values()))
    assert len(sizes) == 1
    assert sizes.pop() < 10


@pytest.mark.parametrize("metric", metrics())
def test_empty_metric_refuses_to_compute(metric: SequenceMetric) -> None:
    with pytest.warns(UserWarning, match="before the"), pytest.raises(ValueError, match="has no sequence"):
        metric.compute()
    metric.update(motion(0)[:0], motion(1)[:0])  # a batch of no sequence adds nothing
    with pytest.raises(ValueError, match="has no sequence"):
        metric.compute()
    metric.update(motion(0), motion(1))
    metric.compute()


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


def test_states_and_regions_stay_out_of_checkpoints() -> None:
    assert not torch.nn.ModuleList(metrics()).state_dict()


def test_updates_work_in_and_out_of_inference_mode() -> None:
    metric = MeanVertexError()
    with torch.inference_mode():
        metric.update(motion(0), motion(1))
    metric.update(motion(0), motion(1))
    assert metric.coverage().sequences == 4


def test_no_graph_is_kept() -> None:
    metric = MeanVertexError()
    assert not metric(motion(0).requires_grad_(), motion(1)).requires_grad
    assert not metric.compute().requires_grad


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
