"""The motion of the second edition, against what was measured in people."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.speech.espeak import SpokenPhoneme
from facediff.synthetic.articulation import speech_sounds
from facediff.synthetic.head.rig import SHAPES
from facediff.synthetic.performance import MOODS, FaceMotion, SpeakingHabits, synthesise_motion
from facediff.synthetic.prosody import ProsodyContours

RATE = 100.0


def performance(seconds: float = 60.0, seed: int = 0, mood: str = "neutral", **habits: float) -> FaceMotion:
    """A performance of vowels and closures in turn."""
    phonemes = [SpokenPhoneme(0.12 * k, 0.12 * (k + 1), "mɑbitu"[k % 6]) for k in range(int(seconds / 0.12))]
    times = np.arange(0.0, seconds, 0.01)
    melody = np.sin(2 * np.pi * 0.6 * times)
    contours = ProsodyContours(times, melody, melody)
    frames = int(seconds * RATE)
    random = np.random.default_rng(seed)
    return synthesise_motion(speech_sounds(phonemes), contours, frames, RATE, SpeakingHabits(**habits), mood, random)


def column(motion: FaceMotion, name: str) -> np.ndarray:
    return motion.weights[:, SHAPES.index(name)]


def test_equal_seeds_move_alike_and_others_do_not() -> None:
    first, again, other = performance(6.0), performance(6.0), performance(6.0, seed=1)
    assert np.array_equal(first.weights, again.weights)
    assert np.abs(column(first, "browInnerUp") - column(other, "browInnerUp")).max() > 0.05
    assert np.abs(column(first, "jawOpen") - column(other, "jawOpen")).max() < 0.1  # speech decides the mouth
    assert first.weights.min() >= 0.0
    assert np.isfinite(first.head).all()


@pytest.mark.parametrize("rate", [12.0, 30.0])
def test_blinks_come_and_last_as_in_people(rate: float) -> None:
    motion = performance(150.0, blinks=rate, gaze_away=0.0)
    shut = column(motion, "eyeBlinkLeft") > 0.5
    starts = np.flatnonzero(np.diff(shut.astype(int)) == 1)
    assert len(starts) / 2.5 == pytest.approx(rate, rel=0.4)
    lengths = np.array([np.argmin(shut[start + 1 :]) for start in starts[:-1]]) / RATE
    assert 0.08 < np.median(lengths) < 0.2  # above half shut; about half of the whole blink


def test_saccades_follow_the_main_sequence() -> None:
    motion = performance(120.0, gaze_away=0.4)
    speed = np.linalg.norm(np.diff(motion.gaze, axis=0), axis=1) * RATE
    moving = speed > 40.0
    starts = np.flatnonzero(np.diff(moving.astype(int)) == 1)
    for start in starts[:60]:
        end = start + 1 + int(np.argmin(moving[start + 1 :]))
        size = float(np.linalg.norm(motion.gaze[min(end + 1, len(motion.gaze) - 1)] - motion.gaze[start]))
        assert (end - start) / RATE < 0.021 + 0.0022 * max(size, 1.0) + 3.0 / RATE
    away = np.linalg.norm(motion.gaze, axis=1) > 3.5
    assert 0.15 < away.mean() < 0.6
    # Both eyes turn together: to the left one goes outwards and the other inwards.
    assert np.array_equal(column(motion, "eyeLookOutLeft"), column(motion, "eyeLookInRight"))


def test_moods_change_the_size_of_what_is_said_but_no_closure() -> None:
    by_mood = {mood: performance(20.0, mood=mood) for mood in MOODS}
    jaws = [column(by_mood[mood], "jawOpen").mean() for mood in ("flat", "neutral", "lively")]
    assert jaws == sorted(jaws)
    for mood, motion in by_mood.items():
        open_ = column(motion, "jawOpen") - column(motion, "mouthClose")
        closed = [open_[int((0.72 * k + 0.06) * RATE)] for k in range(1, 20)]  # the middle of each m
        assert max(closed) < 0.02, mood


def test_heads_sway_slowly_and_lean_by_habit() -> None:
    motion = performance(120.0, tilt=4.0)
    assert motion.head[:, 2].mean() == pytest.approx(4.0, abs=1.0)
    spectrum = np.abs(np.fft.rfft(motion.head[:, 1] - motion.head[:, 1].mean())) ** 2
    frequencies = np.fft.rfftfreq(len(motion.head), 1.0 / RATE)
    assert spectrum[frequencies < 2.0].sum() / spectrum.sum() > 0.95
    assert 0.3 < motion.head.std(axis=0).max() < 8.0  # degrees
