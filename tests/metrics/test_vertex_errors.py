"""Every option combination against float64 NumPy, in any batching and order, padded or not."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any

import pytest
import torch

from facediff.metrics import (
    FaceDynamicsDeviation,
    LipVertexError,
    MeanVertexError,
    SequenceMetric,
    face_dynamics_deviation,
    lip_vertex_error,
    mean_vertex_error,
)
from facediff.metrics.base import Pooling, Reduction, Sign
from facediff.metrics.vertex_errors import VertexError

Corpus = Any  # the class of that name in conftest.py, which test files cannot import
BATCHINGS = ([[0], [1], [2], [3], [4]], [[0, 1, 2, 3, 4]], [[4, 2], [0, 3, 1]])
POOLINGS = ("frames", "sequences")


def accumulate(metric: SequenceMetric, corpus: Corpus, batching: list[list[int]]) -> float:
    """The metric's value after updates of the batches."""
    for number, places in enumerate(batching):
        batch = corpus.batch(places, extra=number)
        if not isinstance(metric, FaceDynamicsDeviation):
            batch.pop("template")
        metric.update(**batch)
    return metric.compute().item()


@pytest.mark.parametrize("batching", BATCHINGS, ids=("singly", "at_once", "shuffled"))
@pytest.mark.parametrize(("reduction", "squared", "pooling"), list(product(("mean", "max"), (True, False), POOLINGS)))
def test_mean_vertex_error(
    corpus: Corpus,
    vertex_error_reference: Callable[..., float],
    reduction: Reduction,
    squared: bool,
    pooling: Pooling,
    batching: list[list[int]],
) -> None:
    options: dict[str, Any] = {"reduction": reduction, "squared": squared, "pooling": pooling}
    expected = vertex_error_reference(corpus, None, **options)
    assert accumulate(MeanVertexError(**options), corpus, batching) == pytest.approx(expected, rel=1e-6)
    batch = corpus.batch(range(5))
    batch.pop("template")
    assert mean_vertex_error(**batch, **options).item() == pytest.approx(expected, rel=1e-6)


def test_a_vertex_error_of_ones_own_region_is_the_mean_distance_over_all_frames(
    corpus: Corpus, vertex_error_reference: Callable[..., float]
) -> None:
    region, options = [1, 4, 7], {"reduction": "mean", "squared": False, "pooling": "frames"}
    expected = vertex_error_reference(corpus, region, **options)
    assert accumulate(VertexError(region), corpus, BATCHINGS[1]) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("batching", BATCHINGS, ids=("singly", "at_once", "shuffled"))
@pytest.mark.parametrize(("squared", "pooling"), list(product((True, False), POOLINGS)))
def test_lip_vertex_error(
    corpus: Corpus,
    lips: tuple[int, ...],
    vertex_error_reference: Callable[..., float],
    squared: bool,
    pooling: Pooling,
    batching: list[list[int]],
) -> None:
    options: dict[str, Any] = {"squared": squared, "pooling": pooling}
    expected = vertex_error_reference(corpus, lips, reduction="max", **options)
    assert accumulate(LipVertexError(lips, **options), corpus, batching) == pytest.approx(expected, rel=1e-6)
    batch = corpus.batch(range(5))
    batch.pop("template")
    assert lip_vertex_error(lips=lips, **batch, **options).item() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("batching", BATCHINGS, ids=("singly", "at_once", "shuffled"))
@pytest.mark.parametrize("sign", ["signed", "absolute"])
def test_face_dynamics_deviation(
    corpus: Corpus,
    upper: tuple[int, ...],
    dynamics_reference: Callable[..., float],
    sign: Sign,
    batching: list[list[int]],
) -> None:
    expected = dynamics_reference(corpus, upper, sign=sign)
    metric = FaceDynamicsDeviation(upper, sign=sign)
    assert accumulate(metric, corpus, batching) == pytest.approx(expected, rel=1e-6)
    value = face_dynamics_deviation(upper=upper, sign=sign, **corpus.batch(range(5)))
    assert value.item() == pytest.approx(expected, rel=1e-6)


def test_long_sequences_are_worked_in_pieces_with_the_same_result() -> None:
    truth, prediction = torch.randn(2, 9, 23370, 3, generator=torch.manual_seed(0)).unbind(0)
    expected = (truth.double() - prediction.double()).norm(dim=-1).mean().item()
    assert mean_vertex_error(prediction, truth).item() == pytest.approx(expected, rel=1e-12)
    spreads = [motion.double().square().sum(-1).std(0, correction=0).mean() for motion in (truth, prediction)]
    found = face_dynamics_deviation(prediction, truth, range(23370), sign="signed")
    assert found.item() == pytest.approx((spreads[0] - spreads[1]).item(), rel=1e-9)


def test_agrees_with_torchmetrics_over_a_ragged_corpus(corpus: Corpus, lips: tuple[int, ...]) -> None:
    theirs = pytest.importorskip("torchmetrics.multimodal.lve").LipVertexError(list(lips))
    ours = LipVertexError(lips)
    for prediction, truth in zip(corpus.predictions, corpus.truths, strict=True):
        both = torch.from_numpy(prediction), torch.from_numpy(truth)
        theirs.update(*both)
        ours.update(*both)
    assert ours.compute().item() == pytest.approx(theirs.compute().item(), rel=1e-5)  # theirs is in float32


def test_offsets_and_absolute_vertices_give_the_same(corpus: Corpus, upper: tuple[int, ...]) -> None:
    batch = corpus.batch([2, 3])
    template = batch.pop("template")
    absolute = face_dynamics_deviation(upper=upper, template=template, **batch)
    offsets = {name: batch[name].double() - template[:, None] for name in ("prediction", "truth")}
    moved = face_dynamics_deviation(upper=upper, lengths=batch["lengths"], **offsets)
    torch.testing.assert_close(absolute, moved, rtol=1e-12, atol=0)


def test_one_template_serves_a_whole_batch(corpus: Corpus, upper: tuple[int, ...]) -> None:
    batch = corpus.batch([2, 3])
    shared = batch.pop("template")[0]
    one = face_dynamics_deviation(upper=upper, template=shared, **batch)
    many = face_dynamics_deviation(upper=upper, template=torch.stack([shared, shared]), **batch)
    assert one == many
