"""The melody of speech, of voices that are made by formula."""

from __future__ import annotations

import numpy as np
import pytest

from facediff.speech.prosody import SPAN, ProsodyTracker, pitch_of

RATE = 16_000


def voice(pitch: np.ndarray, *, syllables: float = 4.0, loudness: np.ndarray | float = 0.1) -> np.ndarray:
    """Eleven harmonics of a pitch in Hertz (S,), four syllables a second."""
    phase = 2 * np.pi * np.cumsum(pitch) / RATE
    wave = sum(np.sin(number * phase) / number for number in range(1, 12))
    return loudness * wave * (0.55 - 0.45 * np.cos(2 * np.pi * syllables * np.arange(len(pitch)) / RATE))


def heard(speech: np.ndarray, pieces: int = 1) -> ProsodyTracker:
    prosody = ProsodyTracker()
    for piece in np.array_split(speech, pieces):
        prosody.feed(piece)
    prosody.finish()
    return prosody


def times(prosody: ProsodyTracker, kind: str) -> list[float]:
    return [event.time for event in prosody.events if event.kind == kind]


SECONDS = np.arange(3 * RATE) / RATE
SILENCE = np.zeros(RATE // 2)


@pytest.mark.parametrize("pitch", [70.0, 110.0, 233.3, 480.0])
def test_pitch_of_a_voice_is_its_fundamental_frequency(pitch: float) -> None:
    speech = voice(np.full(SPAN, pitch), syllables=0)
    noise = 0.001 * np.random.default_rng(0).standard_normal(SPAN)
    found = pitch_of(speech + noise)
    assert found == pytest.approx(pitch, rel=0.005)


def test_noise_and_silence_have_no_pitch() -> None:
    assert pitch_of(np.random.default_rng(0).standard_normal(SPAN)) is None
    assert pitch_of(np.zeros(SPAN)) is None


def test_silence_before_an_onset_has_no_pitch() -> None:
    """A resampler's noise far below hearing, and then a plosive's puff of air, which moves the mean of the piece."""
    for seed in range(20):
        piece = 1e-9 * np.random.default_rng(seed).standard_normal(SPAN)
        piece[501:] += 0.02
        assert pitch_of(piece) is None


@pytest.mark.parametrize("peak", [1.2, 1.9])
def test_accent_is_where_the_pitch_rises(peak: float) -> None:
    pitch = 120 * 2 ** (6 / 12 * np.exp(-(((SECONDS - peak) / 0.1) ** 2)))
    found = heard(np.concatenate([SILENCE, voice(pitch), SILENCE]))
    assert times(found, "accent") == [pytest.approx(0.5 + peak, abs=0.06)]


def test_monotonous_speech_has_stresses_but_no_accents() -> None:
    found = heard(np.concatenate([SILENCE, voice(np.full(len(SECONDS), 150.0)), SILENCE]))
    assert times(found, "accent") == []
    stresses = times(found, "stress")
    np.testing.assert_allclose(stresses, 0.625 + 0.25 * np.arange(len(stresses)), atol=0.02)
    assert len(stresses) >= 11


def test_phrases_end_where_a_pause_begins() -> None:
    phrase, short = voice(np.full(RATE, 150.0)), voice(np.full(RATE // 4, 150.0))
    found = heard(np.concatenate([SILENCE, phrase, SILENCE, SILENCE, short, SILENCE, SILENCE, phrase]))
    assert times(found, "phrase_end") == [pytest.approx(1.5, abs=0.1), pytest.approx(4.75, abs=0.1)]


def test_silence_and_hiss_have_no_melody() -> None:
    assert heard(np.zeros(2 * RATE)).events == []
    assert heard(1e-3 * np.random.default_rng(0).standard_normal(3 * RATE)).events == []


def test_what_is_heard_does_not_depend_on_the_pieces() -> None:
    pitch = 120 * 2 ** (np.sin(2 * np.pi * 0.7 * SECONDS) / 2)
    speech = np.concatenate([SILENCE, voice(pitch), SILENCE, voice(pitch[: RATE * 2])])
    whole = heard(speech).events
    assert len(whole) > 10
    for pieces in (7, 501):
        assert heard(speech, pieces).events == whole
