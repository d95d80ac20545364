"""When the sounds of a transcript are spoken in a recording."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.speech.phonemes import TimedPhoneme, spoken_by_machine
from facediff.speech.voice_activity import EnergyGate, openness
from facediff.utils import SAMPLE_RATE

RATE = 100.0
"""Steps a second of the alignment."""

LONGEST = 2000
"""Characters of a transcript; a longer recording is better aligned by a program made for it."""


def align_transcript(text: str, speech: npt.NDArray[np.float32]) -> list[TimedPhoneme]:
    """Phonemes in time of a recording (S,) at 16 kHz in which an English text is spoken.

    The text is spoken by espeak-ng, which knows its times, and both are aligned by dynamic time warping of cepstra
    without the mean of the voice. This is coarser than an aligner trained on people (50 ms are usual), but needs none.

    Raises:
        FaceDiffError: if the text is empty or too long, or the recording is silent.
        MissingExtraError: if espeak-ng or the library for warping is not installed.
    """
    import torch

    from facediff.models.style_content.losses import align, cepstra

    if not any(letter.isalpha() for letter in text) or len(text) > LONGEST:
        raise FaceDiffError(f"--transcript: has {len(text)} characters; expected English words, at most {LONGEST}")
    samples, voiced = spoken_by_machine(text)
    steps = max(2, int(len(speech) / SAMPLE_RATE * RATE))
    heard = np.flatnonzero(openness(speech, steps, RATE, EnergyGate(lead=0.02, attack=0.0, hold=0.02, release=0.0)))
    if not len(heard):
        raise FaceDiffError("--transcript: nobody speaks in the recording; omit it, or give another recording")
    first, last = int(heard[0]), int(heard[-1]) + 1
    part = speech[round(first / RATE * SAMPLE_RATE) : round(last / RATE * SAMPLE_RATE)]
    begin, end = voiced[0].start, voiced[-1].end
    model = samples[round(begin * SAMPLE_RATE) : round(end * SAMPLE_RATE)]
    counts = [max(2, int(len(each) / SAMPLE_RATE * RATE)) for each in (model, part)]
    features = [
        cepstra(torch.from_numpy(np.ascontiguousarray(each)), count, RATE)
        for each, count in zip((model, part), counts, strict=True)
    ]
    path = align(*features)

    def time(seconds: float) -> float:
        """When something is said that the synthesiser says at a time."""
        place = np.interp((seconds - begin) * RATE, np.arange(len(path)) + 0.5, path + 0.5)
        return float(first + place) / RATE

    found = [TimedPhoneme(time(each.start), time(each.end), each.ipa) for each in voiced]
    return [each for each in found if each.end > each.start]
