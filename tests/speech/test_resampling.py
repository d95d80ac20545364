"""Resampling of streams: against formulas of sines and against soxr, in pieces of any length."""

from __future__ import annotations

import numpy as np
import pytest
import soxr

from facediff.speech.resampling import Resampler

RATES = [(48_000, 16_000), (44_100, 16_000), (32_000, 16_000), (8_000, 16_000), (16_000, 48_000), (16_000, 44_100)]


def in_pieces(resampler: Resampler, samples: np.ndarray) -> np.ndarray:
    cuts = np.sort(np.random.default_rng(0).integers(0, len(samples), 40))
    pieces = [resampler(piece) for piece in np.split(samples, cuts)]
    return np.concatenate([*pieces, resampler(np.zeros(0, np.float32), True)])


@pytest.mark.parametrize(("source", "target"), RATES)
def test_sine_stays_a_sine(source: int, target: int) -> None:
    time = np.arange(source // 2) / source
    for frequency in (100.0, 0.4 * min(source, target)):
        made = in_pieces(Resampler(source, target), np.sin(2 * np.pi * frequency * time).astype(np.float32))
        assert abs(len(made) - target // 2) <= 1
        wanted = np.sin(2 * np.pi * frequency * np.arange(len(made)) / target)
        inside = slice(100, -100)  # the ends hear silence
        assert np.abs(made - wanted)[inside].max() < 2e-3


@pytest.mark.parametrize(("source", "target"), RATES)
def test_pieces_do_not_matter(source: int, target: int) -> None:
    samples = np.random.default_rng(1).normal(size=source // 4).astype(np.float32)
    whole = Resampler(source, target)
    wanted = np.concatenate([whole(samples), whole(np.zeros(0, np.float32), True)])
    assert np.allclose(in_pieces(Resampler(source, target), samples), wanted, atol=1e-6)


@pytest.mark.parametrize(("source", "target"), RATES)
def test_noise_below_the_cut_off_is_that_of_soxr(source: int, target: int) -> None:
    rng, low = np.random.default_rng(2), min(source, target)
    spectrum = np.fft.rfft(rng.normal(size=source))
    spectrum[int(0.4 * low) :] = 0
    noise = np.fft.irfft(spectrum, source).astype(np.float32)
    made, wanted = in_pieces(Resampler(source, target), noise), soxr.resample(noise, source, target, quality="VHQ")
    count = min(len(made), len(wanted)) - 200
    assert np.abs(made[200:count] - wanted[200:count]).max() < 3e-3 * np.abs(wanted).max()


def test_what_the_lower_rate_cannot_hold_is_gone() -> None:
    high = np.sin(2 * np.pi * 9_000 * np.arange(48_000) / 48_000).astype(np.float32)
    assert np.abs(in_pieces(Resampler(48_000, 16_000), high)[200:-200]).max() < 1e-3


def test_equal_rates_pass_through() -> None:
    samples = np.arange(5, dtype=np.float32)
    assert Resampler(16_000, 16_000)(samples) is samples
