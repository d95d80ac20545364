"""Blinks against series whose number is known, the built-in corpus's own count, and the nearest speaker in NumPy."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import facediff.metrics as fm
from facediff.metrics.eyes import count_blinks
from facediff.synthetic import motion as puppet
from facediff.synthetic.corpus import SyntheticClip, generate_clip, rig_of
from facediff.synthetic.face import build_face
from facediff.synthetic.rig import eyelid_pairs

LIDS = [(0, 1)]


def face(opening: Tensor) -> Tensor:
    """Absolute vertices (…, 2, 3) of a face whose eyes are open so far."""
    return opening[..., None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])


def blinking(*at: int, frames: int = 120, depth: float = 0.9, open_to: float = 1.0) -> Tensor:
    opening = torch.full((frames,), open_to, dtype=torch.float64)
    for place in at:
        opening[place : place + 4] = open_to * (1 - depth)
    return opening


@pytest.mark.parametrize(
    ("opening", "blinks"),
    [
        (blinking(), 0),
        (blinking(20, 60, 100), 3),
        (blinking(0, 60), 2),  # shut in the first frame
        (blinking(20, 60, depth=0.49), 0),
        (blinking(20, 60, depth=0.51), 2),
        (blinking(20, 60, open_to=0.4), 2),  # heavy lids: the share is of their own usual opening
        (torch.zeros(50), 0),
    ],
)
def test_blinks_are_counted(opening: Tensor, blinks: int) -> None:
    assert count_blinks(opening).item() == blinks


def test_a_blink_is_over_only_when_the_eyes_are_nearly_open_again() -> None:
    trembling = torch.tensor([1.0, 1, 1, 0.2, 0.65, 0.2, 0.65, 0.2, 1, 1, 1])  # 0.65 open is 0.35 shut
    assert count_blinks(trembling).item() == 1
    assert count_blinks(trembling, reopened=0.4).item() == 3
    with pytest.raises(ValueError, match="reopened"):
        fm.BlinkRateRatio(LIDS, closed=0.3, reopened=0.4)


def test_a_blink_is_beyond_its_limits_and_not_at_them() -> None:
    at, beyond = torch.tensor([1.0, 1, 1, 0.5, 1, 1, 1]), torch.tensor([1.0, 1, 1, 0.499, 1, 1, 1])
    assert (count_blinks(at).item(), count_blinks(beyond).item()) == (0, 1)
    ajar, apart = (torch.tensor([1.0, 1, 1, 0.1, open_to, 0.1, 1, 1, 1]) for open_to in (0.75, 0.76))
    found = [count_blinks(each, closed=0.5, reopened=0.25).item() for each in (ajar, apart)]
    assert found == [1, 2]


@pytest.mark.parametrize(
    "options",
    [{"reopened": -0.01}, {"closed": 1.0}, {"closed": 0.3, "reopened": 0.31}, {"closed": float("nan")}],
    ids=str,
)
def test_limits_that_are_no_shares_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="closed is"):
        fm.BlinkRateRatio(LIDS, **options)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="closed is"):
        fm.BlinkRate(LIDS, frames_per_second=25, **options)  # type: ignore[arg-type]
    assert fm.BlinkRateRatio(LIDS, closed=0.0, reopened=0.0).closed == 0.0
    assert fm.BlinkRateRatio(LIDS, closed=0.4, reopened=0.4).reopened == 0.4


def test_limits_count_what_they_say() -> None:
    half, wide = face(blinking(20, 60, depth=0.6, frames=100)), face(blinking(20, frames=100))
    for options, ratio in (({}, 2.0), ({"closed": 0.7}, 0.0), ({"closed": 0.05, "reopened": 0.01}, 2.0)):
        assert fm.blink_rate_ratio(half, wide, LIDS, **options).item() == ratio  # type: ignore[arg-type]
    words = fm.BlinkRate(LIDS, frames_per_second=12.5, of="truth", closed=0.45, reopened=0.2).describe()
    assert "blinks of the truth over minutes at 12.5 frames a second" in words
    assert "above 0.45 after it was below 0.2" in words
    assert words.endswith("[a minute]")


def test_the_ratio_is_one_of_sums_and_the_rate_one_of_minutes() -> None:
    predictions = torch.stack([face(blinking(30, frames=100)), face(blinking(frames=100))])
    truths = torch.stack([face(blinking(20, 50, 80, frames=100)), face(blinking(20, frames=100))])
    assert fm.blink_rate_ratio(predictions, truths, LIDS).item() == 0.25
    assert fm.blink_rate_ratio(predictions, truths, LIDS, lengths=[60, 100]).item() == pytest.approx(1 / 3)
    rates = [fm.blink_rate(predictions, truths, LIDS, frames_per_second=20, of=of) for of in ("prediction", "truth")]
    assert [rate.item() for rate in rates] == [pytest.approx(6.0), pytest.approx(24.0)]  # in 10 seconds
    offsets = predictions - face(torch.ones(1))
    neutral = face(torch.ones(1))[0]
    metric = fm.BlinkRate(LIDS, frames_per_second=20)
    metric.update(offsets, offsets, offsets_from=neutral)
    assert metric.compute().item() == pytest.approx(6.0)
    with pytest.raises(ValueError, match="frames_per_second"):
        fm.BlinkRate(LIDS)
    with pytest.raises(ValueError, match="nobody blinks"):
        fm.blink_rate_ratio(truths, face(torch.ones(2, 100)), LIDS)


def test_the_built_in_corpus_blinks_as_often_as_was_drawn(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def noted(times: np.ndarray, style: object, random: np.random.Generator) -> np.ndarray:
        shut = made(times, style, random)
        inside = (times > 0.1) & (times < times[-1] - 0.1)
        high = (shut > 0.5) & inside
        drawn.append(int(high[0]) + int(np.sum(high[1:] & ~high[:-1])))
        return shut

    made = puppet._blinks
    monkeypatch.setattr(puppet, "_blinks", noted)
    pairs = np.stack(eyelid_pairs(build_face()), 1)
    assert pairs.shape == (14, 2)
    found = []
    for number, mood in ((28, "lively"), (29, "flat"), (31, "neutral")):
        _, weights, _ = generate_clip(SyntheticClip("F1", number, mood))
        motion = torch.from_numpy(rig_of("F1").pose(weights))
        metric = fm.BlinkRate(pairs.tolist(), frames_per_second=25)
        metric.update(motion, motion)
        found.append(round(metric.compute().item() * len(motion) / 1500))
    assert sum(drawn) > 0
    assert found == drawn


def gallery(people: int = 4, clips: int = 9) -> tuple[fm.SpeakerGallery, np.ndarray, np.ndarray]:
    """People whose faces differ little, and vary a lot in one way that all of them share."""
    rng = np.random.default_rng(0)
    own, mood = rng.normal(size=(people, 6, 3)), 5 * rng.normal(size=(6, 3))
    labels = np.repeat(np.arange(people), clips)
    means = own[labels] + rng.normal(size=(len(labels), 1, 1)) * mood + 0.1 * rng.normal(size=(len(labels), 6, 3))
    return fm.SpeakerGallery(torch.from_numpy(means), tuple(labels.tolist())), own, mood


def test_the_nearest_speaker_is_found_whatever_the_mood() -> None:
    known, own, mood = gallery()
    rng = np.random.default_rng(1)
    clips = own[:, None] + 2 * rng.normal(size=(4, 1, 1, 1)) * mood + 0.3 * rng.normal(size=(4, 30, 6, 3))
    motion = torch.from_numpy(clips)
    euclid = [np.square(known.means.numpy() - clip.mean(0)).sum((1, 2)).argmin() // 9 for clip in clips]
    assert euclid != [0, 1, 2, 3]  # mood would decide
    assert fm.nearest_speaker_accuracy(motion, [0, 1, 2, 3], known, shrinkage=1e-3).item() == 1.0
    assert fm.nearest_speaker_accuracy(motion, [1, 2, 3, 0], known, shrinkage=1e-3).item() == 0.0
    template = torch.from_numpy(rng.normal(size=(4, 6, 3)))
    absolute = motion + template[:, None]
    found = fm.nearest_speaker_accuracy(absolute, [0, 1, 2, 3], known, shrinkage=1e-3, template=template)
    assert found.item() == 1.0


def test_the_nearest_speaker_is_that_of_the_documented_distance() -> None:
    known, _, _ = gallery()
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


def test_the_nearest_speaker_follows_from_offsets_alone() -> None:
    """Where the gallery's faces all lie to one side, this side says nothing of a speaker."""
    known, own, mood = gallery()
    rng = np.random.default_rng(3)
    motion = torch.from_numpy(own[:, None] + rng.normal(size=(4, 1, 1, 1)) * mood + np.zeros((4, 3, 6, 3)))
    aside = torch.from_numpy(100 * rng.normal(size=(6, 3)))
    moved = fm.SpeakerGallery(known.means + aside, known.speakers)
    for gallery_of, shift in ((known, 0 * aside), (moved, aside)):
        found = fm.NearestSpeakerAccuracy(gallery_of, components=8)
        found.update(motion + shift, [0, 1, 2, 3])
        assert found.compute().item() == 1.0


def test_fewer_recordings_than_components_have_one_less_than_themselves() -> None:
    known, _, _ = gallery(people=3, clips=2)
    metric = fm.NearestSpeakerAccuracy(known)
    assert metric.basis.shape == (5, 18)
    torch.testing.assert_close(metric.basis @ metric.basis.T, torch.eye(5, dtype=torch.float64), rtol=0, atol=1e-9)
    offsets = known.means.flatten(1) - known.means.flatten(1).mean(0)
    torch.testing.assert_close(offsets @ metric.basis.T @ metric.basis, offsets, rtol=0, atol=1e-9)
    assert "among 3, by Mahalanobis distance within speakers in 16 principal components of 6" in metric.describe()


def test_one_recording_of_each_speaker_is_compared_in_euclidean_distance() -> None:
    rng = np.random.default_rng(4)
    means = torch.from_numpy(rng.normal(size=(3, 5, 3)))
    clips = torch.from_numpy(rng.normal(size=(50, 2, 5, 3)))
    gaps = clips.mean(1).flatten(1)[:, None] - means.flatten(1)
    metric = fm.NearestSpeakerAccuracy(fm.SpeakerGallery(means, (4, 9, 6)))
    metric.update(clips, [(4, 9, 6)[place] for place in gaps.square().sum(2).argmin(1)])
    assert metric.compute().item() == 1.0


@pytest.mark.parametrize("options", [{"components": 0}, {"components": -1}, {"shrinkage": 0.0}, {"shrinkage": -0.1}])
def test_a_space_without_components_and_a_covariance_that_may_vanish_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        fm.NearestSpeakerAccuracy(gallery()[0], **options)  # type: ignore[arg-type]


def test_a_speaker_without_recordings_is_left_out() -> None:
    known, _, _ = gallery()
    metric = fm.NearestSpeakerAccuracy(known)
    metric.update(known.means[:, None][[0, 0]], [0, 7])
    assert metric.compute().item() == 1.0
    assert metric.coverage().left_out == 1
    with pytest.raises(ValueError, match="vertices"):
        metric.update(torch.rand(1, 5, 4, 3), [0])
    with pytest.raises(ValueError, match="two speakers"):
        fm.SpeakerGallery(known.means[:2], (3, 3))
