"""Scores of articulation: against curves that are made to have them, and of a mouth that mumbles."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.data.articulation import MouthMotion, area_under_curve, articulation, mouth_motion
from facediff.speech.phonemes import TimedPhoneme

SAID = ["m", "ˈaː", "p", "uː", "s", "iː", "b", "a", "f", "", "w", "ɛ"] * 3
LENGTH = 0.2
PHONEMES = [TimedPhoneme(LENGTH * n, LENGTH * (n + 1), ipa) for n, ipa in enumerate(SAID)]
GAPS = {
    "m": 0.2,
    "p": 0.3,
    "b": 0.1,
    "ˈaː": 9.0,
    "a": 7.0,
    "uː": 4.0,
    "s": 2.0,
    "iː": 3.0,
    "f": 2.5,
    "w": 3.0,
    "ɛ": 6.0,
}
WIDTHS = {"uː": -5.0, "w": -6.0}


def motion(scale: float = 1.0, shift: float = 0.0, contact: float | None = None) -> MouthMotion:
    """A mouth at 25 frames a second that takes each sound's shape throughout it."""
    times = (np.arange(round(LENGTH * len(SAID) * 25)) + 0.5) / 25
    said = [SAID[min(int(time / LENGTH), len(SAID) - 1)] for time in times]
    gap = np.array([shift + scale * GAPS.get(ipa, 0.0) for ipa in said])
    width = np.array([scale * WIDTHS.get(ipa, 0.0) for ipa in said])
    teeth = None if contact is None else np.where(np.array(said) == "f", contact, 5.0)
    return MouthMotion(gap, width, 25.0, PHONEMES, teeth)


def test_a_mouth_that_does_all_has_the_best_scores() -> None:
    scores = articulation([motion(contact=0.4)])
    assert scores.closure_auc == 1
    assert scores.closed == 1
    assert scores.chance == 0
    assert scores.open_vowels == pytest.approx(8.0)
    assert scores.rounding == pytest.approx(-5.5)
    assert scores.rounding_auc == 1
    assert scores.contact == 1
    assert articulation([motion(contact=1.5)]).contact == 0
    assert np.isnan(articulation([motion()]).contact)


def test_scores_cannot_be_had_by_mumbling() -> None:
    """A mouth at a tenth closes in time, but at all other times too, and opens and rounds by a tenth."""
    truth, mumbled = articulation([motion()]), articulation([motion(0.1)])
    assert mumbled.closed == 1
    assert mumbled.chance == 1
    shares = mumbled.shares_of(truth)
    assert [shares[name] for name in ("open_vowels", "rounding", "closed")] == pytest.approx([0.1, 0.1, 1.0])
    assert np.isnan(shares["chance"])  # the truth's is 0
    assert articulation([motion(0.0)]).closure_auc == 0.5
    assert articulation([motion(0.0)]).rounding_auc == 0.5


def test_a_shift_in_time_is_seen() -> None:
    late = motion()
    late = MouthMotion(np.roll(late.gap, 5), np.roll(late.width, 5), 25.0, PHONEMES)
    assert articulation([late]).closure_auc < 0.6


def test_area_under_curve_is_the_share_of_pairs() -> None:
    random = np.random.default_rng(0)
    high, low = random.integers(0, 9, 40).astype(float), random.integers(0, 7, 30).astype(float)
    pairs = [(a > b) + 0.5 * (a == b) for a in high for b in low]
    assert area_under_curve(high, low) == pytest.approx(np.mean(pairs))


def test_curves_of_vertices_are_in_millimetres_beyond_rest() -> None:
    """Upper and lower lips at three places; the outermost pair is the corners."""
    rest = np.array([[-20, 1, 0], [0, 1, 0], [20, 1, 0], [-20, 0, 0], [0, 0, 0], [20, 0, 0]], float)
    pairs = np.array([[0, 3], [1, 4], [2, 5]])
    opened = rest.copy()
    opened[4, 1] -= 6.0
    narrow = rest.copy()
    narrow[[0, 3], 0] += 4.0
    curves = mouth_motion(
        np.stack([rest, opened, narrow]) / 1000, rest / 1000, pairs, millimetres=1000, frame_rate=25, phonemes=[]
    )
    np.testing.assert_allclose(curves.gap, [0, 2, 0], atol=1e-9)
    np.testing.assert_allclose(curves.width, [0, 0, -4], atol=1e-9)
