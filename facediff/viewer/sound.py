"""The speech of a page: 16-bit PCM in a WAVE file, which every browser plays and seeks to the sample."""

from __future__ import annotations

import io
import wave
from collections.abc import Sequence

import numpy as np

from facediff.errors import FaceDiffError
from facediff.takes import Take


def first_sound(takes: Sequence[Take]) -> bytes | None:
    """The speech of the first take that has any, exactly as long as the motion, as a .wav; None if all are silent.

    Raises:
        FaceDiffError: if it is not finite.
    """
    for take in takes:
        sound = take.sound()
        if sound is not None:
            if not np.isfinite(sound).all():
                raise FaceDiffError(f"{take.name}: its speech holds NaN or infinity; read the recording anew")
            return to_wav(sound, take.sample_rate)
    return None


def to_wav(sound: np.ndarray, sample_rate: int) -> bytes:
    """Mono samples (S,), full scale 1, as a .wav file of 16 bits."""
    stream = io.BytesIO()
    with wave.open(stream, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(sample_rate)
        # Readers divide by 32768, so that a 16-bit recording comes back bit by bit.
        file.writeframes(np.clip(np.rint(sound * 32768), -32768, 32767).astype("<i2").tobytes())
    return stream.getvalue()
