"""Recordings of speech as a command takes them: neither too short nor silent."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MIN_SECONDS = 0.2
SILENCE = 1e-4


def read_checked(path: Path, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Speech (S,) at 16 kHz.

    Raises:
        FaceDiffError: if the file cannot be read, holds only silence, or lasts too short or too long.
    """
    import numpy as np

    from facediff.data.audio import SAMPLE_RATE, read_speech

    speech = read_speech(path)
    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{path}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")
    if max_seconds is not None and seconds > max_seconds:
        raise FaceDiffError(
            f"{path}: lasts {seconds:.0f} s, more than --max-seconds {max_seconds:g}; cut it or raise the limit"
        )
    if float(np.abs(speech).max()) < SILENCE:
        raise FaceDiffError(f"{path}: holds only silence; expected a recording of speech")
    return speech
