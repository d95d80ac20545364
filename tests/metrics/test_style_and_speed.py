"""Style retrieval accuracy and real-time factor."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torchmetrics import MetricCollection

from facediff.metrics import (
    RealTimeFactor,
    StyleRetrievalAccuracy,
    device_name,
    real_time_factor,
    style_retrieval_accuracy,
)
from facediff.metrics.style import Closeness

Anything = Any  # right and wrong labels


def accuracy(points: np.ndarray[Any, Any], labels: list[int], closeness: str) -> float:
    """Leave one out, one at a time; equally near ones share."""
    right = []
    for i, mine in enumerate(labels):
        if labels.count(mine) < 2:
            continue
        others = [j for j in range(len(labels)) if j != i]
        if closeness == "cosine":
            unit = points / np.linalg.norm(points, axis=1, keepdims=True)
            score = [float(unit[i] @ unit[j]) for j in others]
        else:
            score = [-float(np.linalg.norm(points[i] - points[j])) for j in others]
        nearest = [j for j, s in zip(others, score, strict=True) if s >= max(score) - 1e-12]
        right.append(np.mean([labels[j] == mine for j in nearest]))
    return float(np.mean(right))


@pytest.mark.parametrize("closeness", ["cosine", "euclidean"])
@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 30))
def test_accuracy_is_leave_one_out(closeness: Closeness, seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    points, labels = rng.standard_normal((count, 3)), [0, 0, *rng.integers(0, 4, count - 2).tolist()]
    expected = accuracy(points, labels, closeness)
    embeddings = torch.from_numpy(points)
    assert style_retrieval_accuracy(embeddings, labels, closeness=closeness).item() == pytest.approx(expected)
    order = torch.randperm(count, generator=torch.manual_seed(seed))
    metric = StyleRetrievalAccuracy(closeness=closeness)
    for part in order.split(7):
        metric.update(embeddings[part], torch.tensor(labels)[part])
    assert metric.compute().item() == pytest.approx(expected)
    assert metric.queries() == sum(labels.count(label) > 1 for label in labels)


def test_ties_count_by_share_in_any_order() -> None:
    embeddings = torch.tensor([[0.0], [1.0], [1.0], [2.0]])
    labels = torch.tensor([0, 0, 1, 1])
    # 0: ties with both at 1, half right; each at 1 has the other of another label nearest, wrong; 2: half right.
    for order in ([0, 1, 2, 3], [3, 2, 1, 0], [2, 0, 3, 1]):
        found = style_retrieval_accuracy(embeddings[order], labels[order], closeness="euclidean")
        assert found.item() == 0.25


def test_a_label_of_its_own_is_found_but_does_not_ask() -> None:
    embeddings = torch.tensor([[0.0], [3.0], [1.0]])
    metric = StyleRetrievalAccuracy(closeness="euclidean")
    metric.update(embeddings, [0, 0, 5])
    assert (metric.compute().item(), metric.queries()) == (0.0, 2)
    alone = StyleRetrievalAccuracy()
    alone.update(embeddings[1:], [0, 1])
    with pytest.raises(ValueError, match="2 style embeddings, 0 of them with another of the same label"):
        alone.compute()


def test_cosine_sees_no_length_and_euclid_does() -> None:
    embeddings = torch.tensor([[1.0, 0.0], [50.0, 1.0], [1.0, 1.2], [40.0, 41.0]])
    assert style_retrieval_accuracy(embeddings, [0, 0, 1, 1]).item() == 1.0
    assert style_retrieval_accuracy(embeddings, [0, 0, 1, 1], closeness="euclidean").item() == 0.0


def test_embeddings_survive_pickling_reset_halving_and_forward() -> None:
    embeddings = torch.randn(8, 4, generator=torch.manual_seed(0))
    labels = [0, 1] * 4
    metric = StyleRetrievalAccuracy()
    batch_value = metric(embeddings, labels)
    assert metric.compute() == batch_value == style_retrieval_accuracy(embeddings, labels)
    twin = pickle.loads(pickle.dumps(metric)).half()  # noqa: S301
    twin.update(embeddings[:0], [])
    assert twin.compute() == batch_value
    metric.reset()
    with pytest.warns(UserWarning, match="before the"), pytest.raises(ValueError, match="0 style embeddings"):
        metric.compute()
    metric.update(embeddings[:, :2].half(), labels)  # another size after a reset
    assert metric.compute().dtype == torch.float64
    assert not metric.state_dict()
    collection = MetricCollection([StyleRetrievalAccuracy(), StyleRetrievalAccuracy().clone()][:1])
    collection.update(embeddings, labels)
    assert collection.compute()["StyleRetrievalAccuracy"] == batch_value


@pytest.mark.parametrize(
    ("embeddings", "labels", "message"),
    [
        (torch.ones(3), [0, 0, 0], r"embeddings have shape \(3,\)"),
        (torch.ones(2, 3).long(), [0, 0], "expected floating-point"),
        (torch.ones(2, 3), [0], "labels must be 2 whole numbers"),
        (torch.ones(2, 3), [0.5, 1.0], "labels must be 2 whole numbers"),
        (torch.ones(2, 4), [0, 0], "embeddings of 4 numbers after others of 3"),
        (torch.tensor([[1.0, 0, 0], [0, 0, 0]]), [0, 0], "the embedding of b .* is all zero"),
        (torch.tensor([[1.0, 0, float("nan")], [1, 0, 0]]), [0, 0], "the embedding of a holds NaN"),
    ],
)
def test_embeddings_that_do_not_fit_are_refused(embeddings: torch.Tensor, labels: Anything, message: str) -> None:
    metric = StyleRetrievalAccuracy()
    metric.update(torch.eye(3), [0, 0, 1])
    with pytest.raises(ValueError, match=message):
        metric.update(embeddings, labels, clip_names=["a", "b"])
    assert metric.queries() == 2


@settings(max_examples=25, deadline=None)
@given(st.lists(st.tuples(st.floats(0, 100), st.floats(0.1, 100)), min_size=1, max_size=9))
def test_the_factor_is_a_ratio_of_sums(times: list[tuple[float, float]]) -> None:
    expected = sum(took for took, _ in times) / sum(spoken for _, spoken in times)
    metric = RealTimeFactor("one core")
    for took, spoken in times:
        metric.update(took, spoken)
    assert metric.compute().item() == pytest.approx(expected)
    took, spoken = torch.tensor(times, dtype=torch.float64).unbind(1)
    assert real_time_factor(took, spoken).item() == pytest.approx(expected)


def test_measuring_takes_the_time_inside(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([10.0, 12.5, 20.0, 90.0])
    monkeypatch.setattr("facediff.metrics.speed.time.perf_counter", lambda: next(clock))
    metric = RealTimeFactor(device_name("cpu"))
    with metric.measure(speech=5.0):
        pass
    with pytest.raises(RuntimeError, match="inside"), metric.measure(speech=1.0):
        raise RuntimeError("inside")
    assert metric.compute().item() == 0.5
    assert f"on {device_name('cpu')} [1]" in metric.describe()
    assert "thread" in device_name("cpu")


def test_times_that_are_none_are_refused() -> None:
    metric = RealTimeFactor("one core")
    for took, spoken in ((-1.0, 1.0), (1.0, 0.0), (float("nan"), 1.0), (1.0, float("inf"))):
        with pytest.raises(ValueError, match="must be positive seconds"):
            metric.update(took, spoken)
    with pytest.raises(ValueError, match="computing times of 2 clips, speech of 1"):
        metric.update(torch.ones(2), 1.0)
    with pytest.raises(ValueError, match="has no clip"):
        metric.compute()
    with pytest.raises(ValueError, match="hardware is empty"):
        RealTimeFactor(" ")
    metric.update(1.0, 4.0)
    metric.half()
    assert pickle.loads(pickle.dumps(metric)).compute().item() == 0.25  # noqa: S301
