"""Recordings of speech as a command takes them: neither too short nor silent."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

MIN_SECONDS = 0.2
SILENCE = 1e-4


def refuse_replacing(recordings: Sequence[Path], outputs: Sequence[Path]) -> None:
    """Refuse to write an animation over a recording: a video whose speech is taken may have the animation's suffix.

    Raises:
        FaceDiffError: naming the output.
    """
    heard = {recording.resolve() for recording in recordings}
    for output in outputs:
        if output.resolve() in heard:
            raise FaceDiffError(f"--output: {output} is itself a recording and would be replaced; choose another place")


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
