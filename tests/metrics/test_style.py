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

import facediff.metrics as fm
from facediff.metrics import (
    StyleRetrievalAccuracy,
    style_retrieval_accuracy,
)
from facediff.metrics.style import Closeness


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


def gallery(people: int = 4, clips: int = 9) -> fm.SpeakerGallery:
    """People whose faces differ little, and vary a lot in one way that all of them share."""
    rng = np.random.default_rng(0)
    own, mood = rng.normal(size=(people, 6, 3)), 5 * rng.normal(size=(6, 3))
    labels = np.repeat(np.arange(people), clips)
    means = own[labels] + rng.normal(size=(len(labels), 1, 1)) * mood + 0.1 * rng.normal(size=(len(labels), 6, 3))
    return fm.SpeakerGallery(torch.from_numpy(means), tuple(labels.tolist()))


def test_the_nearest_speaker_is_that_of_the_documented_distance() -> None:
    known = gallery()
    rng = np.random.default_rng(2)
    means, labels = known.means.numpy().reshape(36, -1), np.array(known.speakers)
    for components, shrinkage in ((3, 0.1), (16, 0.5), (40, 0.2)):  # there are 18
        _, _, axes = np.linalg.svd(means - means.mean(0), full_matrices=False)
        points = (means - means.mean(0)) @ axes[:components].T
        own = np.stack([points[labels == person].mean(0) for person in range(4)])
        within = points - own[labels]
        covariance = within.T @ within / (36 - 4)
        size = len(covariance)
        inverse = np.linalg.inv(covariance + shrinkage * np.trace(covariance) / size * np.eye(size))
        clips = rng.normal(size=(40, 5, 6, 3)) * 4
        gaps = ((clips.mean(1).reshape(40, -1) - means.mean(0)) @ axes[:components].T)[:, None] - own
        nearest = np.einsum("npi,ij,npj->np", gaps, inverse, gaps).argmin(1)
        metric = fm.NearestSpeakerAccuracy(known, components=components, shrinkage=shrinkage)
        metric.update(torch.from_numpy(clips), nearest.tolist())
        assert metric.compute().item() == 1.0
        template = torch.from_numpy(rng.normal(size=(6, 3)))
        metric.update(torch.from_numpy(clips) + template, ((nearest + 1) % 4).tolist(), template=template)
        assert metric.compute().item() == 0.5


def test_a_speaker_without_recordings_is_left_out() -> None:
    known = gallery()
    metric = fm.NearestSpeakerAccuracy(known)
    metric.update(known.means[:, None][[0, 0]], [0, 7])
    assert metric.compute().item() == 1.0
    assert metric.coverage().left_out == 1
    with pytest.raises(ValueError, match="vertices"):
        metric.update(torch.rand(1, 5, 4, 3), [0])
