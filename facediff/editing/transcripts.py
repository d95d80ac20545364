"""When the sounds of a transcript are spoken in a recording."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import OptionError
from facediff.speech.cepstra import align_features, cepstra
from facediff.speech.phonemes import MOST_CHARACTERS, OTHER_PACE, TimedPhoneme, spoken_by_machine
from facediff.speech.voice_activity import EnergyGate, openness
from facediff.utils import SAMPLE_RATE

RATE = 100.0
"""Steps a second of the alignment."""


def align_transcript(text: str, speech: npt.NDArray[np.float32]) -> list[TimedPhoneme]:
    """Phonemes in time of a recording (S,) at 16 kHz in which an English text is spoken.

    espeak-ng speaks the text, which gives the times of its phonemes, and both recordings are aligned by dynamic time
    warping of standardised cepstra. This is coarser than an aligner trained on people (50 ms are usual), but needs
    none.
    """
    if not any(letter.isalpha() for letter in text) or len(text) > MOST_CHARACTERS:
        raise OptionError(
            "transcript", f"has {len(text)} characters; expected English words, at most {MOST_CHARACTERS}"
        )
    synthetic, voiced = spoken_by_machine(text)
    steps = max(2, int(len(speech) / SAMPLE_RATE * RATE))
    active = np.flatnonzero(openness(speech, steps, RATE, EnergyGate(lead=0.02, attack=0.0, hold=0.02, release=0.0)))
    begin, end = voiced[0].start, voiced[-1].end
    # Pauses aside, people do not speak so much faster or slower.
    if not len(active) or not 1 / OTHER_PACE < (end - begin) * RATE / len(active) < OTHER_PACE:
        raise OptionError(
            "transcript",
            f"takes {end - begin:.1f} s to say, and the recording has {len(active) / RATE:.1f} s of speech; expected "
            f"all words of this recording",
        )
    # Only the stretch with speech is aligned: silence around it would be spread over the first and the last sound.
    first, last = int(active[0]), int(active[-1]) + 1
    recorded = speech[round(first / RATE * SAMPLE_RATE) : round(last / RATE * SAMPLE_RATE)]
    synthetic = synthetic[round(begin * SAMPLE_RATE) : round(end * SAMPLE_RATE)]
    path = align_features(
        *(cepstra(wave, max(2, int(len(wave) / SAMPLE_RATE * RATE)), RATE) for wave in (synthetic, recorded))
    )

    def recorded_time(seconds: float) -> float:
        """The time in the recording of a time in the synthesised speech."""
        step = np.interp((seconds - begin) * RATE, np.arange(len(path)) + 0.5, path + 0.5)
        return float(first + step) / RATE

    aligned = [TimedPhoneme(recorded_time(sound.start), recorded_time(sound.end), sound.ipa) for sound in voiced]
    return [sound for sound in aligned if sound.end > sound.start]
