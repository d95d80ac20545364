"""Raw samples: 16 bits, mono, little endian, as recorders and players send them through pipes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from typing import IO

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

CHUNK = 0.02
"""Seconds of speech that are read at a time, at most."""

SOUND_FILES = (*b"RIFF RIFX RF64 fLaC OggS FORM caff ID3 FLV\1 #!AMR".split(), b"\x1a\x45\xdf\xa3")
"""Beginnings of sound files, which are no samples."""


def pcm(source: IO[bytes], rate: int, read: Callable[[int, int], bytes] = os.read) -> Iterator[npt.NDArray[np.float32]]:
    """Pieces (n,) of speech, full scale 1, as 16-bit mono samples (little endian) of ``rate`` come in from a file.

    ``read`` works as ``os.read``; half a sample at the end is dropped.
    """
    rest, first = b"", True
    # A read of a pipe gives the bytes that are there, at least one, and nothing at its end.
    while data := read(source.fileno(), max(2, round(CHUNK * rate) * 2)):
        if first and (data.startswith(SOUND_FILES) or data[4:8] in (b"ftyp", b"moov", b"mdat")):
            raise FaceDiffError(
                "standard input holds a sound file, not samples; give the file by its name, or only its samples "
                "(ffmpeg -i FILE -f s16le -ac 1 -ar 16000 -)"
            )
        data, first = rest + data, False
        even = len(data) // 2 * 2
        rest = data[even:]
        yield samples_of(data[:even])


def samples_of(data: bytes) -> npt.NDArray[np.float32]:
    """16-bit samples (little endian) as (n,) with full scale 1."""
    return np.frombuffer(data, "<i2").astype(np.float32) / np.float32(32_768)
