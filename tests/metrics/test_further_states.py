"""Metrics as torchmetrics classes: forward, reset, pickling, moves, memory, collections, and what has no value."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torchmetrics import MetricCollection

from facediff.metrics import (
    BilabialClosureRate,
    ClipSpeechLipCorrelation,
    Coverage,
    FaceDynamicsDeviation,
    IdentityDiversity,
    LipOpeningCorrelation,
    LipSpeedCorrelation,
    LipWarpingDistance,
    MeanVertexError,
    MotionLiveliness,
    MouthOpeningDifference,
    RealTimeFactor,
    SequenceMetric,
    SpectrumDistance,
    TemporalMisalignment,
    face_dynamics_deviation,
    mouth_opening_difference,
)
from tests.metrics.further_cases import CASES, LIPS, PAIRS, UPPER, Case, closure_batch, offsets_batch

Corpus = Any  # the class of that name in conftest.py
ONE_OF_EACH = list({case.make().__class__: case for case in reversed(CASES)}.values())
one_of_each = pytest.mark.parametrize("case", ONE_OF_EACH, ids=str)


@one_of_each
def test_reset_pickle_and_copy(case: Case, corpus: Corpus) -> None:
    metric = case.make()
    metric.update(**case.arguments(corpus, [0, 2], 0))
    value = metric.compute()
    for twin in (pickle.loads(pickle.dumps(metric)), copy.deepcopy(metric), metric.clone()):  # noqa: S301
        assert twin.compute() == value
        twin.update(**case.arguments(corpus, [3, 4], 0))
        assert twin.coverage() != metric.coverage()
    assert metric.compute() == value
    metric.reset()
    assert metric.coverage() == Coverage(0, 0, 0, 0)
    assert not torch.nn.ModuleList([metric]).state_dict()


@pytest.mark.parametrize(
    "metric", [MeanVertexError(), MeanVertexError(pooling="sequences"), FaceDynamicsDeviation([1, 2])]
)
def test_forward_gives_the_batch_and_adds_to_the_whole(metric: SequenceMetric) -> None:
    first, second = metric(**moving(6)), metric(**moving(3))
    assert metric.coverage() == Coverage(9, 2, 0, 0)
    weight = 0.5 if metric.pooling == "sequences" else 2 / 3
    torch.testing.assert_close(metric.compute(), weight * first + (1 - weight) * second)


@one_of_each
def test_memory_is_constant(case: Case, corpus: Corpus) -> None:
    metric = case.make()
    sizes = set()
    for place in (2, 3, 0, 2, 3):
        metric.update(**case.arguments(corpus, [place], 0))
        sizes.add(sum(torch.as_tensor(state).numel() for state in metric.metric_state.values()))
    assert len(sizes) == 1
    assert sizes.pop() < 60


@one_of_each
def test_sums_stay_in_float64_and_out_of_the_graph(case: Case, corpus: Corpus) -> None:
    metric = case.make()
    batch = case.arguments(corpus, [0, 2, 3], 0)
    with torch.inference_mode():
        metric.update(**batch)
    value = metric.compute().item()
    torch.nn.ModuleList([torch.nn.Linear(1, 1), metric]).half()
    assert metric.compute().item() == value
    for state in metric.metric_state.values():
        assert state.dtype in (torch.float64, torch.int64)
    metric.reset()
    grown = {name: part.clone().requires_grad_() for name, part in batch.items() if name in ("prediction", "samples")}
    metric.update(**(batch | grown))
    assert not metric.compute().requires_grad
    assert metric.compute().item() == value


@one_of_each
def test_an_empty_metric_refuses_to_compute(case: Case, corpus: Corpus) -> None:
    metric = case.make()
    batch = case.arguments(corpus, [0, 2], 0)
    metric.update(**{name: value[:0] for name, value in batch.items()})
    with pytest.raises(ValueError, match="has no sequence to score; call update"):
        metric.compute()
    metric.update(**batch)
    metric.compute()


@one_of_each
def test_a_metric_says_what_it_is(case: Case) -> None:
    metric = case.make()
    words = metric.describe()
    assert words.endswith(("[unit]", "[unit²]", "[1]", "[frames]", "[ms]", "[dB]", "[bit]"))
    assert "{" not in words
    regions = [str(getattr(metric, name)) for name in ("region", "pairs") if hasattr(metric, name)]
    assert any(name in words for name in regions if name != "None") or "all vertices" in words


def moving(frames: int, **more: Any) -> dict[str, Any]:  # noqa: ANN401
    """A clip as arguments of a metric."""
    clips = torch.randn(2, 1, frames, 5, 3, generator=torch.manual_seed(frames))
    return {"prediction": clips[0], "truth": clips[1]} | more


STILL = moving(40, truth=torch.zeros(1, 40, 5, 3))


@pytest.mark.parametrize(
    ("make", "too_little", "enough", "message"),
    [
        (partial(LipWarpingDistance, [0, 1]), {}, moving(40), "no sequence"),
        (partial(MotionLiveliness, [0, 1]), STILL, moving(40), "divide by zero"),
        (partial(SpectrumDistance, [0, 1]), STILL, moving(40), "divide by zero"),
        (partial(RealTimeFactor, "this machine"), {}, {"computing": 2.0, "speech": 3.0}, "no clip"),
    ],
)
@pytest.mark.filterwarnings("ignore:The ``compute`` method")  # torchmetrics' own, of compute before update
def test_a_metric_goes_on_after_processes_had_too_little(
    make: Callable[..., Any], too_little: dict[str, Any], enough: dict[str, Any], message: str
) -> None:
    """It leaves the states of all processes; here of two, of which one has nothing."""

    def gathered(state: torch.Tensor, group: object) -> list[torch.Tensor]:
        return [state, torch.zeros_like(state)]

    alone, one_of_two = (
        make(dist_sync_fn=gathered, distributed_available_fn=lambda several=several: several)
        for several in (False, True)
    )
    for metric in (alone, one_of_two):
        if too_little:
            metric.update(**too_little)
        with pytest.raises(ValueError, match=message):
            metric.compute()
        metric.update(**enough)
    assert one_of_two.compute().item() == pytest.approx(alone.compute().item(), rel=1e-12)


def test_definitions_differ_wherever_numbers_do() -> None:
    words = {}
    for case in CASES:
        told = case.make().describe()
        assert words.setdefault(told, case.expected) is case.expected or case.name.endswith(("offsets", "410-25"))


def test_one_frame_clips() -> None:
    one = torch.randn(2, 1, 5, 3, generator=torch.manual_seed(0))
    speech, pairs = torch.ones(2, 1), [(0, 1)]
    for metric, more in (
        (LipOpeningCorrelation(pairs), {}),
        (LipSpeedCorrelation([0, 1]), {}),
        (TemporalMisalignment(pairs), {}),
        (BilabialClosureRate(pairs), {"closures": [[], []]}),
        (ClipSpeechLipCorrelation([0, 1]), {"intensity": speech}),
    ):
        metric.update(one, one + 1, **more)
        assert metric.coverage() == Coverage(0, 0, 0, 0, left_out=2)
        with pytest.raises(ValueError, match="has no value on any of its 2 sequences: "):
            metric.compute()
    alone = IdentityDiversity()
    alone.update(one[:, None])
    assert alone.coverage().left_out == 2
    assert TemporalMisalignment(pairs, at="path")(one, one + 1) == 0


def test_left_out_sequences_are_counted_and_do_not_weigh(corpus: Corpus) -> None:
    rate = BilabialClosureRate(PAIRS)
    rate.update(**closure_batch(corpus, [0, 1, 2, 3, 4], 0))
    assert rate.coverage() == Coverage(frames=6 + 1 + 12 + 1, sequences=4, cut_prediction=0, cut_truth=0, left_out=1)
    closures = BilabialClosureRate(PAIRS, count="closures")
    closures.update(**closure_batch(corpus, [3, 2], 0))
    assert closures.coverage() == Coverage(frames=3, sequences=1, cut_prediction=0, cut_truth=0, left_out=1)


def test_a_collection_feeds_metrics_of_absolute_vertices_and_of_offsets(corpus: Corpus) -> None:
    collection = MetricCollection(
        {
            "fdd": FaceDynamicsDeviation(UPPER),
            "mod": MouthOpeningDifference(PAIRS),
            "mod_by_sequence": MouthOpeningDifference(PAIRS, pooling="sequences"),
            "pcc": LipOpeningCorrelation(PAIRS),
            "speed": LipSpeedCorrelation(LIPS),
        }
    )
    absolute, offsets = corpus.batch([0, 2]), offsets_batch(corpus, [0, 2], 0)
    collection.update(**absolute)  # FDD subtracts the template, the opening needs none
    first = collection.compute()
    collection.reset()
    collection.update(**offsets)  # FDD has offsets already, the opening adds the template
    for name, value in collection.compute().items():
        torch.testing.assert_close(value, first[name], rtol=1e-9, atol=0)
    template = absolute.pop("template")
    assert first["fdd"] == face_dynamics_deviation(upper=UPPER, template=template, **absolute)
    assert first["mod"] == mouth_opening_difference(pairs=PAIRS, **absolute)
    assert first["mod"] != first["mod_by_sequence"]
