"""The speech beside an animation: 16-bit PCM in a RIFF WAVE file that says who wrote it."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError
from facediff.export.place import check_free, is_free
from facediff.takes import Take


def speech_name(path: Path) -> str:
    """The file beside ``path`` for the speech: ``hello.wav``, or ``hello_speech.wav`` where the former is the user's.

    Raises:
        FaceDiffError: if neither is free.
    """
    plain = path.with_suffix(".wav")
    if is_free(plain):
        return plain.name
    other = path.with_name(f"{path.stem}_speech.wav")
    check_free(other)
    return other.name


def write_wav(path: Path, take: Take) -> None:
    """Write the speech, exactly as long as the motion.

    The entry ISFT (software) comes before the samples, so that an export never overwrites a recording of the user's.

    Raises:
        FaceDiffError: if the speech is not finite.
    """
    sound = take.sound()
    if sound is None:
        return
    if not np.isfinite(sound).all():
        raise FaceDiffError(f"{take.name}: its speech holds NaN or infinity; read the recording anew")
    # Readers divide by 32768, so that a 16-bit recording comes back bit by bit.
    data = np.clip(np.rint(sound * 32768), -32768, 32767).astype("<i2").tobytes()
    rate = take.sample_rate
    chunks = [
        (b"fmt ", struct.pack("<HHIIHH", 1, 1, rate, 2 * rate, 2, 16)),
        (b"LIST", b"INFOISFT" + struct.pack("<I", 10) + b"facediff\0\0"),
        (b"data", data),
    ]
    body = b"WAVE" + b"".join(name + struct.pack("<I", len(content)) + content for name, content in chunks)
    path.write_bytes(b"RIFF" + struct.pack("<I", len(body)) + body)
