"""Reading speech: files of any common format, rate and number of channels become 16 kHz mono."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError, OptionError
from facediff.speech.cut_short import refuse_cut_short
from facediff.utils import SAMPLE_RATE as SAMPLE_RATE
from facediff.utils.arrays import ArrayStore
from facediff.utils.limits import LIMITS, SAMPLE_RATES, brief, check_number

SUFFIXES = (".wav", ".flac", ".ogg", ".mp3", ".opus", ".aiff")
CONTAINERS = (".flv", ".m4a", ".mp4", ".mov", ".mkv", ".webm", ".avi", ".aac")
"""Videos and similar containers, whose sound PyAV extracts."""

DEMUXERS = "flv,mov,mp4,m4a,matroska,webm,avi,aac,mpegts,mpeg,mp3,ogg,wav,flac,aiff,w64,caf"
"""What FFmpeg may take such a file for: not a playlist, which names other files and addresses to be opened."""

CHANNELS = 64
"""Most channels of a recording; microphone arrays and Ambisonics have fewer."""

LOUDEST = 2.0**31
"""Largest sample; even whole numbers of 32 bits that were not scaled to 1 stay below."""

BLOCK = 1 << 18
"""Samples of all channels together that are decoded at a time."""

UNKNOWN = 1 << 62
"""libsndfile gives a length above this where a stream does not tell it."""


def read_speech(path: Path, *, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Read a recording, or the sound of a video, as (S,) float32 mono at 16 kHz.

    Channels are averaged; another rate is resampled by soxr (high quality). What the file declares is checked before
    anything is decoded, and decoding ends where the speech becomes too long.

    Args:
        path: the file.
        max_seconds: longest speech allowed; the budget's :attr:`~facediff.utils.limits.Limits.seconds` if that is less.

    Raises:
        FaceDiffError: if the file is missing, empty, cut short, no sound file, too long, or holds values that are not
            finite.
        MissingExtraError: if PyAV is not installed, which videos need.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such sound file; expected {', '.join(SUFFIXES + CONTAINERS)}")
    if path.stat().st_size == 0:
        raise FaceDiffError(f"{path}: the file is empty; expected a recording of speech")
    refuse_cut_short(path)
    decode = _decode_container if path.suffix.lower() in CONTAINERS else _decode
    samples, rate = decode(path, _Length(path, max_seconds))
    if not len(samples):
        raise FaceDiffError(f"{path}: holds no samples; expected a recording of speech")
    return to_speech(samples, rate, str(path))


def read_sound(file: IO[bytes], name: str, *, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Read an open sound file, such as ``io.BytesIO`` of a .wav, as :func:`read_speech` reads one on disk."""
    length = _Length(Path(name), max_seconds)
    with open_sound(file, name) as sound:
        samples, rate = _decoded(sound, length)
    if not len(samples):
        raise FaceDiffError(f"{name}: holds no samples; expected a recording of speech")
    return to_speech(samples, rate, name)


def to_speech(samples: npt.NDArray[np.floating], rate: float, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) or (S, channels), full scale 1, at any rate as (S',) float32 mono at 16 kHz."""
    import soxr

    if not np.isfinite(samples).all():
        raise FaceDiffError(f"{name}: holds samples that are not finite numbers; convert it again")
    peak = max(float(samples.max(initial=0)), -float(samples.min(initial=0)))
    if peak > LOUDEST:
        raise FaceDiffError(f"{name}: holds a sample of {peak:g}; expected a full scale of 1, convert it again")
    mono = samples if samples.ndim == 1 else samples.mean(axis=1)
    if rate != SAMPLE_RATE:
        mono = soxr.resample(mono, rate, SAMPLE_RATE, quality="HQ")
    return np.ascontiguousarray(mono, dtype=np.float32)


def resampler(rate: int) -> Callable[[npt.NDArray[np.float32], bool], npt.NDArray[np.float32]]:
    """Converts pieces of a stream (n,) at any rate to 16 kHz; the second argument marks the last piece."""
    import soxr

    stream = soxr.ResampleStream(rate, SAMPLE_RATE, 1, dtype="float32", quality="HQ")
    return lambda piece, last: stream.resample_chunk(piece, last=last)


class _Length:
    """Refuses speech that is too long, by what the file declares and by what has been decoded of it.

    Args:
        path: the file.
        most: longest speech allowed in seconds, of an option; None for the budget's alone.
    """

    def __init__(self, path: Path, most: float | None) -> None:
        self.path, self.most = path, most

    def check(self, samples: float, rate: float) -> None:
        """Check a number of samples."""
        seconds = samples / rate
        if self.most is not None and seconds > self.most:
            raise OptionError(
                "max_seconds", f"{self.path} lasts {seconds:.0f} s; cut it or raise the limit", f"{self.most:g}"
            )
        LIMITS.check("seconds", seconds, self.path)


def _check_rate(path: Path, rate: object, channels: object) -> None:
    check_number(path, "its sample rate", rate, *SAMPLE_RATES, remedy="convert it with ffmpeg")
    check_number(path, "its number of channels", channels, 1, CHANNELS, remedy="convert it with ffmpeg")


@contextmanager
def open_sound(source: Path | IO[bytes], name: str = "") -> Iterator[Any]:
    """A ``soundfile.SoundFile`` whose rate and number of channels are in range.

    Args:
        source: the file, or its content.
        name: what messages call a content.
    """
    import soundfile

    path = source if isinstance(source, Path) else Path(name)
    try:
        # As bytes, since a name need not be UTF-8.
        with soundfile.SoundFile(os.fsencode(source) if isinstance(source, Path) else source) as file:
            _check_rate(path, file.samplerate, file.channels)
            yield file
    except (soundfile.LibsndfileError, RuntimeError, TypeError, ValueError, OSError) as error:
        raise FaceDiffError(
            f"{path}: not a readable sound file ({_reason(path, error)}); expected one of {', '.join(SUFFIXES)}"
        ) from error


def _reason(path: Path, error: Exception) -> str:
    """What a library says of a file, without the name that begins the message already."""
    return brief(str(error).replace(f"Error opening {os.fsencode(path)!r}: ", "").replace(str(path), path.name))


def _decode(path: Path, length: _Length) -> tuple[npt.NDArray[np.float32], int]:
    """All samples (S,) of a recording, its channels averaged."""
    with open_sound(path) as file:
        return _decoded(file, length)


def _decoded(file: Any, length: _Length) -> tuple[npt.NDArray[np.float32], int]:  # noqa: ANN401 - a SoundFile
    declared, rate = int(file.frames), int(file.samplerate)
    known = 0 <= declared < UNKNOWN
    if known:
        length.check(declared, rate)
    parts, decoded = [], 0
    while len(block := file.read(max(1, BLOCK // file.channels), dtype="float32", always_2d=True)):
        decoded += len(block)
        length.check(decoded, rate)
        parts.append(block[:, 0].copy() if file.channels == 1 else block.mean(axis=1))
    # Without a frame that tells the number of frames, the length of an mp3 is an estimate.
    if known and decoded < declared and file.format != "MP3":
        raise FaceDiffError(
            f"{length.path}: is cut short or damaged: {decoded} of {declared} samples can be decoded; copy it again"
        )
    return np.concatenate(parts) if parts else np.zeros(0, np.float32), rate


def _decode_container(path: Path, length: _Length) -> tuple[npt.NDArray[np.float32], int]:
    """The first sound track of a video, (S,) mono."""
    try:
        import av
        from av.audio.resampler import AudioResampler
    except ImportError as error:
        raise MissingExtraError("av", "prepare", f"extracting the sound of {path.suffix} files") from error
    parts: list[npt.NDArray[np.float32]] = []
    try:
        with path.open("rb") as stream, av.open(stream, options={"format_whitelist": DEMUXERS}) as container:
            if not container.streams.audio:
                raise FaceDiffError(f"{path}: has no sound track; expected a video with speech")
            track = container.streams.audio[0]
            rate = int(track.rate)
            _check_rate(path, rate, track.channels)
            if track.duration and track.time_base:
                length.check(float(track.duration * track.time_base) * rate, rate)
            plain = AudioResampler(format="fltp", layout="mono", rate=rate)
            decoded = 0
            for frame in chain(container.decode(audio=0), [None]):  # at None, what the resampler still holds comes out
                for part in plain.resample(frame):
                    parts.append(part.to_ndarray()[0])
                    decoded += len(parts[-1])
                length.check(decoded, rate)
    except (av.FFmpegError, AttributeError, ValueError, TypeError, OSError) as error:  # a track may lack its rate
        raise FaceDiffError(f"{path}: its sound cannot be read ({_reason(path, error)}); convert it to .wav") from error
    return np.concatenate(parts) if parts else np.zeros(0, np.float32), rate


def read_stretch(path: Path, first: int, length: int, store: ArrayStore | None) -> npt.NDArray[np.float32]:
    """Samples ``first`` to ``first + length`` at 16 kHz, (length,) float32, filled with zeros past the end.

    Of a 16 kHz mono file only these samples are read. Any other file is decoded as a whole once and kept in ``store``.

    Raises:
        FaceDiffError: as :func:`read_speech`.
    """
    if not path.is_file() or not path.stat().st_size:
        return fit_length(read_speech(path), length)  # which reports what is wrong
    refuse_cut_short(path)
    with open_sound(path) as file:
        if file.samplerate == SAMPLE_RATE and file.channels == 1 and file.seekable():
            file.seek(min(first, file.frames))
            samples = file.read(length, dtype="float32")
            if not np.isfinite(samples).all():
                raise FaceDiffError(f"{path}: holds samples that are not finite numbers; convert it again")
            return fit_length(samples, length)
    if store is None:
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
