"""The nearest speaker against its definition."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import facediff.metrics as fm


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
        small = fm.SpeakerGallery(1e-6 * known.means, known.speakers)  # another unit
        shrunk = 1e-6 * torch.from_numpy(clips), nearest.tolist(), small
        assert fm.nearest_speaker_accuracy(*shrunk, components=components, shrinkage=shrinkage).item() == 1.0
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
