"""Every metric and option against float64 NumPy, in any batching and order, padded or not."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from facediff.metrics import ClipSpeechLipCorrelation
from tests.metrics.further_cases import CASES, Case

Corpus = Any  # the class of that name in conftest.py
BATCHINGS = ([[0], [1], [2], [3], [4]], [[0, 1, 2, 3, 4]], [[4, 2], [0, 3, 1]])
ONE_OF_EACH = list({case.make().__class__: case for case in reversed(CASES)}.values())

each_case = pytest.mark.parametrize("case", CASES, ids=str)
one_of_each = pytest.mark.parametrize("case", ONE_OF_EACH, ids=str)


@each_case
def test_the_score_follows_the_formula_in_any_batching(case: Case, corpus: Corpus) -> None:
    expected = case.expected(corpus)
    assert expected != 0
    metric = case.make()
    for batching in BATCHINGS:
        metric.reset()
        for extra, places in enumerate(batching):
            metric.update(**case.arguments(corpus, places, extra))
        assert metric.compute().item() == pytest.approx(expected, rel=1e-6)
    assert case.twin(**case.arguments(corpus, range(5), 2)).item() == pytest.approx(expected, rel=1e-6)


@one_of_each
def test_one_sequence_without_batch_axis(case: Case, corpus: Corpus) -> None:
    batched = case.arguments(corpus, [2], 0)
    if case.make().__class__ is ClipSpeechLipCorrelation:
        return  # needs two sequences
    single = {name: value[0] for name, value in batched.items()}
    torch.testing.assert_close(case.twin(**single), case.twin(**batched), rtol=1e-12, atol=0)


def motions(arguments: dict[str, Any]) -> dict[str, torch.Tensor]:
    names = ("prediction", "truth", "samples", "predictions")
    return {name: arguments[name] for name in names if name in arguments}


@one_of_each
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_inputs_are_scored_in_float64(case: Case, corpus: Corpus, dtype: torch.dtype) -> None:
    arguments = case.arguments(corpus, range(5), 0)
    halved = case.twin(**(arguments | {name: motion.to(dtype) for name, motion in motions(arguments).items()}))
    assert halved.dtype == torch.float64
    rounded = {name: motion.to(dtype).double() for name, motion in motions(arguments).items()}
    torch.testing.assert_close(halved, case.twin(**(arguments | rounded)), rtol=1e-12, atol=1e-15)


@one_of_each
@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_nan_and_infinity_name_the_clip(case: Case, corpus: Corpus, bad: float) -> None:
    metric = case.make()
    arguments = case.arguments(corpus, [0, 2], 0)
    for name, motion in motions(arguments).items():
        side = "truth" if name == "truth" else "prediction"
        broken = motion.clone()
        broken[1, ..., 11, 7, 1] = bad  # in no region, refused all the same
        with pytest.raises(ValueError, match=rf"the {side} of M3_e40 holds NaN or infinity, first in frame 11;"):
            metric.update(**(arguments | {name: broken}), clip_names=["F2_e37", "M3_e40"])
        assert metric.coverage().sequences == 0


@one_of_each
def test_a_prediction_of_another_length_under_each_rule(case: Case, corpus: Corpus) -> None:
    arguments = case.arguments(corpus, [0, 2], 0)
    if "truth" not in arguments:
        return
    shorter = arguments | {"prediction_lengths": [7, 21]}
    whole = {name: value for name, value in arguments.items() if name != "lengths"}
    metric = case.make()
    metric.update(**shorter)
    coverage = metric.coverage()
    assert (coverage.cut_prediction, coverage.cut_truth) == (0, 9)
    torch.testing.assert_close(metric.compute(), case.twin(**whole, lengths=[7, 21]), rtol=1e-12, atol=1e-12)
    for rule in ("error", "prediction"):
        with pytest.raises(ValueError, match="the prediction has 21 frames, the truth 30"):
            case.twin(**shorter, length_rule=rule, clip_names=["a", "b"])
    longer = whole | {"lengths": [7, 21], "prediction_lengths": [7, 30]}
    torch.testing.assert_close(
        case.twin(**longer, length_rule="prediction"), case.twin(**whole, lengths=[7, 21]), rtol=1e-12, atol=1e-12
    )
