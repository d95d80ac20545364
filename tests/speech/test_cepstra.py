"""Mel filters and cepstra against their formulas, and the alignment of two recordings of one sentence."""

from __future__ import annotations

import math

import numpy as np
import pytest

from facediff.speech.cepstra import align_features, cepstra, mel_filters

RATE = 16_000


@pytest.mark.parametrize(("bands", "size", "low", "high"), [(64, 512, 60.0, 7600.0), (7, 256, 0.0, 4000.0)])
def test_mel_filters_are_their_formula(bands: int, size: int, low: float, high: float) -> None:
    """Triangles between neighbours of evenly spaced mels 2595 log₁₀(1 + f/700), of unit area."""
    first, last = (2595 * math.log10(1 + hertz / 700) for hertz in (low, high))
    edges = 700 * (10 ** (np.linspace(first, last, bands + 2) / 2595) - 1)
    hertz = np.arange(size // 2 + 1) * RATE / size
    expected = [
        np.interp(hertz, edges[band : band + 3], [0, 2 / (edges[band + 2] - edges[band]), 0]) for band in range(bands)
    ]
    np.testing.assert_allclose(mel_filters(bands, size, low, high), expected, rtol=1e-5, atol=1e-9)


def test_cepstra_are_standardised_and_golden() -> None:
    audio = np.random.default_rng(0).normal(size=9_000)
    found = cepstra(audio, 16, 30.0)
    np.testing.assert_allclose(found.mean(0), 0, atol=1e-9)
    np.testing.assert_allclose(found.std(0), 1)
    np.testing.assert_allclose(
        found[3, [0, 1, 12, 13, 25]], [-0.19145, -0.07444, -0.67323, -0.51657, 0.65599], atol=1e-5
    )
    assert not cepstra(audio[:600], 1, 30.0).any()


def test_a_warped_copy_is_aligned() -> None:
    """A copy read at another pace: the alignment follows the warp."""
    rng = np.random.default_rng(0)
    first = np.cumsum(rng.normal(size=(60, 6)), 0)
    pace = np.sort(np.concatenate([np.arange(60), rng.integers(0, 60, 20)]))
    second = first[pace]
    found = align_features(first, second)
    assert (np.diff(found) >= 0).all()
    np.testing.assert_array_equal(pace[found], np.arange(60))


@pytest.mark.parametrize(
    ("frames", "others", "later", "earlier"), [(40, 40, 10, 10), (40, 60, 55, 36), (60, 40, 35, 55)]
)
def test_readings_may_be_apart_by_a_quarter_of_the_longer_one(
    frames: int, others: int, later: int, earlier: int
) -> None:
    """One sound in silence is found up to a quarter away, and further where one reading is slower as a whole."""
    for place, other, found in (
        (2, 2 + later, True),
        (2, 3 + later, False),
        (2 + earlier, 2, True),
        (3 + earlier, 2, False),
    ):
        first, second = np.zeros((frames, 1)), np.zeros((others, 1))
        first[place], second[other] = 1.0, 1.0
        assert (align_features(first, second)[place] == other) == found, (place, other)


def test_slowed_speech_is_aligned() -> None:
    """Speech made of changing tones, and the same at two thirds of the pace."""

    def speech(pace: float) -> np.ndarray:
        time = np.arange(int(RATE * 2 / pace)) / RATE * pace
        pitch = 300 + 1500 * (time * 1.7 % 1) + 400 * np.sin(9 * time)
        return np.sin(2 * np.pi * np.cumsum(pitch) / RATE)

    fast, slow = (cepstra(speech(pace), round(50 / pace), 25.0) for pace in (1.0, 2 / 3))
    found = align_features(fast, slow)
    error = np.abs(found - (np.arange(50) + 0.5) * 1.5)
    assert error.mean() < 1.5, "frames of the slow reading"
