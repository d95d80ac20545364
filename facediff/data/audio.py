"""Reading speech: files of any common format, rate and number of channels become 16 kHz mono."""

from __future__ import annotations

from collections.abc import Callable
from itertools import chain
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils import SAMPLE_RATE as SAMPLE_RATE
from facediff.utils.arrays import ArrayStore

SUFFIXES = (".wav", ".flac", ".ogg", ".mp3", ".opus", ".aiff")
CONTAINERS = (".flv", ".m4a", ".mp4", ".mov", ".mkv", ".webm", ".avi", ".aac")
"""Videos and similar containers, whose sound PyAV extracts."""


def read_speech(path: Path) -> npt.NDArray[np.float32]:
    """Read a recording, or the sound of a video, as (S,) float32 mono at 16 kHz.

    Channels are averaged; another rate is resampled by soxr (high quality).

    Raises:
        FaceDiffError: if the file is missing, empty, no sound file, or holds values that are not finite.
        MissingExtraError: if soundfile or soxr is not installed, or PyAV for a video.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such sound file; expected {', '.join(SUFFIXES + CONTAINERS)}")
    if path.stat().st_size == 0:
        raise FaceDiffError(f"{path}: the file is empty; expected a recording of speech")
    samples, rate = _decode_container(path) if path.suffix.lower() in CONTAINERS else _decode(path)
    if not len(samples):
        raise FaceDiffError(f"{path}: holds no samples; expected a recording of speech")
    return to_speech(samples, rate, str(path))


def to_speech(samples: npt.NDArray[np.floating], rate: float, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) or (S, channels), full scale 1, at any rate as (S',) float32 mono at 16 kHz.

    Raises:
        FaceDiffError: naming ``name``, if the samples hold values that are not finite.
        MissingExtraError: if soxr is not installed.
    """
    try:
        import soxr
    except ImportError as error:
        raise MissingExtraError("soxr", "audio", "resampling speech") from error
    if not np.isfinite(samples).all():
        raise FaceDiffError(f"{name}: holds samples that are not finite numbers; convert it again")
    mono = samples if samples.ndim == 1 else samples.mean(axis=1)
    if rate != SAMPLE_RATE:
        mono = soxr.resample(mono, rate, SAMPLE_RATE, quality="HQ")
    return np.ascontiguousarray(mono, dtype=np.float32)


def resampler(rate: int) -> Callable[[npt.NDArray[np.float32], bool], npt.NDArray[np.float32]]:
    """Converts pieces of a stream (n,) at any rate to 16 kHz; the second argument marks the last piece.

    Raises:
        MissingExtraError: if soxr is not installed.
    """
    try:
        import soxr
    except ImportError as error:
        raise MissingExtraError("soxr", "audio", "resampling speech") from error
    stream = soxr.ResampleStream(rate, SAMPLE_RATE, 1, dtype="float32", quality="HQ")
    return lambda piece, last: stream.resample_chunk(piece, last=last)


def _decode(path: Path) -> tuple[npt.NDArray[np.float32], int]:
    try:
        import soundfile
    except ImportError as error:
        raise MissingExtraError("soundfile", "audio", "reading speech") from error
    try:
        samples, rate = soundfile.read(path, dtype="float32", always_2d=True)
    except (soundfile.LibsndfileError, RuntimeError) as error:
        raise FaceDiffError(
            f"{path}: not a readable sound file ({error}); expected one of {', '.join(SUFFIXES)}"
        ) from error
    return samples, rate


def _decode_container(path: Path) -> tuple[npt.NDArray[np.float32], int]:
    """The first sound track of a video, (S,) mono."""
    try:
        import av
        from av.audio.resampler import AudioResampler
    except ImportError as error:
        raise MissingExtraError("av", "prepare", f"extracting the sound of {path.suffix} files") from error
    try:
        with av.open(str(path)) as container:
            if not container.streams.audio:
                raise FaceDiffError(f"{path}: has no sound track; expected a video with speech")
            rate = int(container.streams.audio[0].rate)
            plain = AudioResampler(format="fltp", layout="mono", rate=rate)
            frames = chain(container.decode(audio=0), [None])  # at None, what the resampler still holds comes out
            parts = [part.to_ndarray()[0] for frame in frames for part in plain.resample(frame)]
    except (av.FFmpegError, ValueError) as error:
        raise FaceDiffError(f"{path}: its sound cannot be read ({error}); convert it to .wav") from error
    return np.concatenate(parts) if parts else np.zeros(0, np.float32), rate


def read_stretch(path: Path, first: int, length: int, store: ArrayStore | None) -> npt.NDArray[np.float32]:
    """Samples ``first`` to ``first + length`` at 16 kHz, (length,) float32, filled with zeros past the end.

    Of a 16 kHz mono file only these samples are read. Any other file is decoded as a whole once and kept in ``store``.

    Raises:
        FaceDiffError: as :func:`read_speech`.
    """
    import soundfile

    try:
        with soundfile.SoundFile(path) as file:
            if file.samplerate == SAMPLE_RATE and file.channels == 1 and file.seekable():
                file.seek(min(first, file.frames))
                samples = file.read(length, dtype="float32")
                if not np.isfinite(samples).all():
                    raise FaceDiffError(f"{path}: holds samples that are not finite numbers; convert it again")
                return fit_length(samples, length)
    except (soundfile.LibsndfileError, RuntimeError):
        pass  # read_speech reports below what is wrong
    if store is None or not path.is_file():
        return fit_length(read_speech(path)[first:], length)
    facts = path.stat()
    key = store.key("speech", SAMPLE_RATE, path.resolve(), facts.st_size, facts.st_mtime_ns)
    speech = store.get(key)
    if speech is None:
        speech = store.put(key, read_speech(path))
    return fit_length(np.array(speech[first : first + length], np.float32), length)


def fit_length(audio: npt.NDArray[np.float32], length: int) -> npt.NDArray[np.float32]:
    """Cut to ``length`` samples, or fill up with zeros at the end."""
    return np.pad(audio[:length], (0, max(0, length - len(audio))))


def samples_for(frames: int, frame_rate: float) -> int:
    """Number of 16 kHz samples that span ``frames`` motion frames."""
    return round(frames * SAMPLE_RATE / frame_rate)
