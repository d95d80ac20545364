"""Pitch and speed of speech are changed by what is asked for, however long it is."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.speech.pitch import shifted, shifted_by_pieces, stretched

RATE = 16_000


@pytest.mark.parametrize("ratio", [0.75, 1.3])
def test_pitch_is_shifted_and_stretching_keeps_it(ratio: float) -> None:
    tone = np.sin(2 * np.pi * 440 * np.arange(2 * RATE) / RATE).astype(np.float32)

    def pitch(sound: np.ndarray) -> float:
        middle = sound[4000:20_000] * np.hanning(16_000)
        return float(np.argmax(np.abs(np.fft.rfft(middle))))

    assert pitch(shifted(tone, ratio)) == pytest.approx(440 * ratio, abs=2)
    longer = stretched(tone, ratio)
    assert len(longer) == round(ratio * len(tone))
    assert pitch(longer) == pytest.approx(440, abs=2)


def test_speech_of_the_same_length_is_the_speech_itself() -> None:
    random = np.random.default_rng(0)
    speech = (random.standard_normal(RATE) * np.linspace(0, 1, RATE) ** 2).astype(np.float32)
    speech[6000:9000] = 0
    np.testing.assert_allclose(stretched(speech, 1.0), speech, atol=1e-6)


@pytest.mark.parametrize("ratio", [0.6, 1.6])
def test_onsets_come_at_their_time_and_stay_sharp(ratio: float) -> None:
    speech = np.zeros(RATE, np.float32)
    starts = np.arange(2000, RATE - 2000, 3000)
    for start in starts:
        speech[start : start + 1500] = np.sin(2 * np.pi * 150 * np.arange(1500) / RATE)
    longer = np.abs(stretched(speech, ratio))
    for start in starts:
        near = longer[int(start * ratio) - 700 : int(start * ratio) + 700]
        loud = np.flatnonzero(near > 0.5)
        assert abs(loud[0] - 700) < 300  # the search goes 160 samples from its place, plus half a grain of 480
        assert loud[0] - np.flatnonzero(near > 0.02)[0] < 240  # no more than one fade


def test_pieces_are_a_shifted_whole_without_gaps() -> None:
    tone = np.sin(2 * np.pi * 440 * np.arange(4 * RATE + 77) / RATE).astype(np.float32)
    made = shifted_by_pieces(tone, 0.75, seconds=0.5)
    assert made.dtype == np.float32
    assert len(made) == len(tone)
    spectrum = np.abs(np.fft.rfft(made[: 4 * RATE] * np.hanning(4 * RATE)))
    assert np.argmax(spectrum) / 4 == pytest.approx(330, abs=2)
    loud = np.sqrt(np.convolve(made[800:-800] ** 2, np.ones(800) / 800, "valid"))
    assert loud.min() > 0.3 * loud.max()  # where two pieces meet, their phases may differ, but nothing is missing
    np.testing.assert_array_equal(shifted_by_pieces(tone, 0.75), shifted(tone, 0.75))


@pytest.mark.parametrize("samples", [1, 100, 700])
def test_short_speech_keeps_its_length(samples: int) -> None:
    made = shifted_by_pieces(np.ones(samples, np.float32), 1.2)
    assert made.shape == (samples,)
    assert np.isfinite(made).all()
