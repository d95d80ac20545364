"""Reading speech: any common file, any rate, mono or not, to 16 kHz mono."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError

SAMPLE_RATE = 16_000
SUFFIXES = (".wav", ".flac", ".ogg", ".mp3", ".opus", ".aiff")


def read_speech(path: Path) -> npt.NDArray[np.float32]:
    """Read a recording as (S,) float32 mono at 16 kHz.

    Channels are averaged; another rate is resampled by soxr (high quality).

    Raises:
        FaceDiffError: if the file is missing, empty, no sound file, or holds values that are not finite.
        MissingExtraError: if soundfile or soxr is not installed.
    """
    try:
        import soundfile
        import soxr
    except ImportError as error:
        raise MissingExtraError("soundfile and soxr", "audio", "reading speech") from error
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such sound file; expected {', '.join(SUFFIXES)}")
    if path.stat().st_size == 0:
        raise FaceDiffError(f"{path}: the file is empty; expected a recording of speech")
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, RuntimeError) as error:
        raise FaceDiffError(
            f"{path}: not a readable sound file ({error}); expected one of {', '.join(SUFFIXES)}"
        ) from error
    if not len(samples):
        raise FaceDiffError(f"{path}: holds no samples; expected a recording of speech")
    if not np.isfinite(samples).all():
        raise FaceDiffError(f"{path}: holds samples that are not finite numbers; convert it anew")
    mono = samples.mean(axis=1)
    if rate != SAMPLE_RATE:
        mono = soxr.resample(mono, rate, SAMPLE_RATE, quality="HQ")
    return np.ascontiguousarray(mono, dtype=np.float32)


def fit_length(audio: npt.NDArray[np.float32], length: int) -> npt.NDArray[np.float32]:
    """Cut to ``length`` samples, or fill up with zeros at the end."""
    return np.pad(audio[:length], (0, max(0, length - len(audio))))


def samples_for(frames: int, frame_rate: float) -> int:
    """Number of 16 kHz samples that span ``frames`` motion frames."""
    return round(frames * SAMPLE_RATE / frame_rate)
