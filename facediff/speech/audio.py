"""Reading speech, in every form that Python and the command line give it in, as samples (S,) at 16 kHz.

From top to bottom: files of any common format, rate and number of channels; stretches of a corpus's files; recordings
to animate, which keep their own sound, with :func:`speech_of` for arrays and files in Python; pieces of a stream;
and whether a file is whole. Nothing here needs PyTorch.
"""

from __future__ import annotations

import io
import mmap
import numbers
import os
import struct
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, OptionError, needs_extra, refuse_idle
from facediff.speech.pcm import samples_of
from facediff.utils import SAMPLE_RATE as SAMPLE_RATE
from facediff.utils.arrays import ArrayStore
from facediff.utils.hints import check_number
from facediff.utils.limits import SAMPLE_RATES, brief

if TYPE_CHECKING:
    from torch import Tensor

    Waveform: TypeAlias = npt.NDArray[np.generic] | Tensor
    Speech: TypeAlias = (
        str | Path | IO[bytes] | Mapping[str, Any] | Waveform | tuple[Waveform, int] | tuple[int, Waveform]
    )

SUFFIXES = (".wav", ".flac", ".ogg", ".mp3", ".opus", ".aiff")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".flv", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".3gp")
CONTAINERS = (*VIDEOS, ".m4a", ".aac")
"""Videos and similar containers; PyAV extracts their sound."""

DEMUXERS = "flv,mov,mp4,m4a,matroska,webm,avi,aac,mpegts,mpeg,mp3,ogg,wav,flac,aiff,w64,caf"
"""What FFmpeg may take such a file for: not a playlist, which names other files and addresses to be opened."""

LOUDEST = 2.0**31
"""Largest sample; even whole numbers of 32 bits that were not scaled to 1 stay below."""

BLOCK = 1 << 18
"""Samples of all channels together that are decoded at a time."""

HOLE = 0.05
"""Seconds of sound that may be missing between two packets of a video before they count as lost."""

LENGTH_IS_KNOWN = ("WAV", "WAVEX", "RF64", "AIFF")
"""Formats whose number of samples follows from the size of the file."""

UNKNOWN = 1 << 62
"""libsndfile gives a length above this where a stream does not tell it."""

MIN_SECONDS = 0.2
"""Of the shortest recording that is animated."""

PLAYED = 48_000
"""Highest sample rate of the sound that an animation keeps, in Hz."""

FULL_SCALE = {"uint8": (128.0, 128), "int16": (32768.0, 0), "int32": (2.0**31, 0)}
"""What whole numbers are divided by to get a full scale of 1, and where they have silence; as .wav files hold them."""


def read_speech(path: Path, *, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Read a recording, or the sound of a video, as (S,) float32 mono at 16 kHz.

    Channels are averaged; another rate is resampled by soxr (high quality). The file's header is checked before
    anything is decoded, and decoding ends where the speech becomes too long.

    Args:
        path: the file.
        max_seconds: longest speech allowed; None for any.
    """
    return to_speech(*_read(path, max_seconds), str(path))


def read_sound_to_play(path: Path) -> tuple[npt.NDArray[np.float32], int]:
    """Read a recording as :func:`read_speech` does, at its own rate from 16 to 48 kHz; the samples and the rate."""
    samples, rate = _read(path, None)
    playable = _rate_to_play(rate)
    return _resampled(_checked(samples, str(path)), rate, playable), playable


def _read(path: Path, max_seconds: float | None) -> tuple[npt.NDArray[np.float32], int]:
    if not path.is_file() or path.stat().st_size == 0:
        raise FaceDiffError(
            f"{path}: no such sound file, or an empty one; expected speech as {', '.join(SUFFIXES + CONTAINERS)}"
        )
    refuse_cut_short(path)
    if path.suffix.lower() in CONTAINERS:
        return _decode_container(path, max_seconds)
    with open_sound(path) as sound:
        return _decoded(sound, path, max_seconds)


def write_wav(path: Path, samples: npt.NDArray[Any], rate: int, bits: int = 16) -> None:
    """Write samples (S,) or (S, channels) as a .wav; libsndfile itself would not say that the disk is full."""
    import soundfile

    sound = io.BytesIO()
    soundfile.write(sound, samples, rate, format="WAV", subtype=f"PCM_{bits}")
    path.write_bytes(sound.getvalue())


def to_speech(samples: npt.NDArray[np.floating], rate: float, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) or (S, channels), full scale 1, at any rate as (S',) float32 mono at 16 kHz."""
    return _resampled(_checked(samples, name), rate, SAMPLE_RATE)


def _rate_to_play(rate: float) -> int:
    """The sample rate at which sound is kept for playing: its own, from 16 to 48 kHz."""
    return int(min(max(rate, SAMPLE_RATE), PLAYED))


def _checked(samples: npt.NDArray[np.floating], name: str) -> npt.NDArray[np.floating]:
    """Mono, where all samples are in range."""
    peak = float(np.maximum(samples.max(initial=0.0), -samples.min(initial=0.0)))  # without a copy of all samples
    if not len(samples) or not peak <= LOUDEST:
        raise FaceDiffError(
            f"{name}: holds no samples, or up to {peak:g}; expected speech of finite numbers with a full scale of 1"
        )
    return samples if samples.ndim == 1 else samples.mean(axis=1)


def _resampled(mono: npt.NDArray[np.floating], rate: float, to: int) -> npt.NDArray[np.float32]:
    if rate != to:
        import soxr

        mono = soxr.resample(mono, rate, to, quality="HQ")
    return np.ascontiguousarray(mono, dtype=np.float32)


def resampler(rate: int) -> Callable[[npt.NDArray[np.float32], bool], npt.NDArray[np.float32]]:
    """Converts pieces of a stream (n,) at any rate to 16 kHz; the second argument marks the last piece."""
    import soxr

    stream = soxr.ResampleStream(rate, SAMPLE_RATE, 1, dtype="float32", quality="HQ")
    return lambda piece, last: stream.resample_chunk(piece, last=last)


def _check_length(path: object, seconds: float, limit: float | None) -> None:
    """Refuse speech that is longer than an option allows, by a file's header and by the decoded samples."""
    if limit is not None and seconds > limit:
        raise OptionError("max_seconds", f"{path} lasts {seconds:.0f} s; cut it or raise the limit", f"{limit:g}")


@contextmanager
def open_sound(source: Path | IO[bytes], name: str = "") -> Iterator[Any]:
    """A ``soundfile.SoundFile``."""
    import soundfile

    path = source if isinstance(source, Path) else Path(name)
    try:
        # As bytes, since a name need not be UTF-8.
        with soundfile.SoundFile(os.fsencode(source) if isinstance(source, Path) else source) as file:
            yield file
    except (soundfile.LibsndfileError, RuntimeError, TypeError, ValueError, OSError) as error:
        raise FaceDiffError(
            f"{path}: not a readable sound file ({_reason(path, error)}); "
            f"expected one of {', '.join(SUFFIXES + CONTAINERS)}"
        ) from error


def _reason(path: Path, error: Exception) -> str:
    """A library's message about a file, without the name that begins it already."""
    return brief(str(error).replace(f"Error opening {os.fsencode(path)!r}: ", "").replace(str(path), path.name))


def _decoded(file: Any, path: object, limit: float | None) -> tuple[npt.NDArray[np.float32], int]:  # noqa: ANN401
    """All samples (S,) of a ``soundfile.SoundFile``, its channels averaged."""
    declared, rate = int(file.frames), int(file.samplerate)
    counted_frames = 0 <= declared < UNKNOWN
    _check_length(path, declared / rate if counted_frames else 0, limit)
    parts, decoded = [], 0
    # A long recording fits once into memory, not twice.
    samples = np.empty(declared, np.float32) if counted_frames and file.format in LENGTH_IS_KNOWN else None
    while len(block := file.read(max(1, BLOCK // file.channels), dtype="float32", always_2d=True)):
        mono = block[:, 0].copy() if file.channels == 1 else block.mean(axis=1)
        if samples is None:
            parts.append(mono)
        else:
            samples[decoded : decoded + len(mono)] = mono
        decoded += len(block)
        _check_length(path, decoded / rate, limit)
    # Without a frame that tells the number of frames, the length of an mp3 is an estimate.
    if counted_frames and decoded < declared and file.format != "MP3":
        raise FaceDiffError(
            f"{path}: is cut short or damaged: {decoded} of {declared} samples can be decoded; copy it again"
        )
    if samples is not None:
        return samples, rate
    return np.concatenate(parts) if parts else np.zeros(0, np.float32), rate


def _decode_container(path: Path, limit: float | None) -> tuple[npt.NDArray[np.float32], int]:
    """The first sound track of a video, (S,) mono, from the time of its first picture on."""
    with needs_extra("av", "prepare", f"extracting the sound of {path.suffix} files"):
        import av
        from av.audio.resampler import AudioResampler
    parts: list[npt.NDArray[np.float32]] = []
    try:
        with path.open("rb") as stream, av.open(stream, options={"format_whitelist": DEMUXERS}) as container:
            if not container.streams.audio:
                raise FaceDiffError(f"{path}: has no sound track; expected a video with speech")
            track = container.streams.audio[0]
            rate = int(track.rate)
            if track.duration and track.time_base:
                _check_length(path, float(track.duration * track.time_base), limit)
            plain = AudioResampler(format="fltp", layout="mono", rate=rate)
            decoded, late, start, heard = 0, None, None, 0
            for frame in chain(container.decode(audio=0), [None]):  # at None, what the resampler still holds comes out
                if late is None and frame is not None:
                    late, start = round(_seconds_after_picture(container, frame.time) * rate), frame.time
                    decoded += max(0, late)
                if frame is not None and start is not None and frame.time is not None:
                    hole = round((frame.time - start) * rate) - heard
                    if hole > HOLE * rate:  # packets were lost: what follows stays in step with the pictures
                        _check_length(path, (decoded + hole) / rate, limit)
                        parts.append(np.zeros(hole, np.float32))
                        decoded, heard = decoded + hole, heard + hole
                    heard += frame.samples
                for part in plain.resample(frame):
                    parts.append(part.to_ndarray()[0])
                    decoded += len(parts[-1])
                _check_length(path, decoded / rate, limit)
    except (av.FFmpegError, AttributeError, ValueError, TypeError, OSError) as error:  # a track may lack its rate
        raise FaceDiffError(f"{path}: its sound cannot be read ({_reason(path, error)}); convert it to .wav") from error
    if not parts or not late:
        return np.concatenate(parts) if parts else np.zeros(0, np.float32), rate
    return np.concatenate([np.zeros(max(0, late), np.float32), *parts])[max(0, -late) :], rate


def _seconds_after_picture(container: Any, sound: float | None) -> float:  # noqa: ANN401 - PyAV's
    """How long after the first picture of a video its sound begins; the picture may also come after it."""
    start = next((track.start_time * track.time_base for track in container.streams.video if track.start_time), 0)
    return 0.0 if sound is None or not container.streams.video else float(sound - start)


def read_stretch(
    path: Path, first: int, length: int, store: ArrayStore | None, complete: set[Path] | None = None
) -> npt.NDArray[np.float32]:
    """Samples ``first`` to ``first + length`` at 16 kHz, (length,) float32, filled with zeros past the end.

    Of a 16 kHz mono file only these samples are read. Any other file is decoded as a whole once and kept in ``store``.
    Files that were looked at to the end are kept in ``complete``, so that a training does so once.
    """
    if not path.is_file() or not path.stat().st_size:
        return fit_length(read_speech(path), length)  # which reports what is wrong
    if complete is None or path not in complete:
        refuse_cut_short(path)
        if complete is not None:
            complete.add(path)
    with open_sound(path) as file:
        if file.samplerate == SAMPLE_RATE and file.channels == 1 and file.seekable():
            file.seek(min(first, file.frames))
            samples = file.read(length, dtype="float32")
            return fit_length(_checked(samples, str(path)) if len(samples) else samples, length)
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


@dataclass(frozen=True, eq=False)
class SpeechRecording:
    """A recording to animate.

    Attributes:
        name: its animation's name.
        speech: (S,) float32 mono at 16 kHz, which models hear.
        sound: (N,) float32 mono, which is played and written with the animation.
        rate: sample rate of the sound in Hz.
    """

    name: str
    speech: npt.NDArray[np.float32]
    sound: npt.NDArray[np.float32]
    rate: int

    @property
    def seconds(self) -> float:
        """Duration of the speech."""
        return len(self.speech) / SAMPLE_RATE

    @classmethod
    def of(cls, samples: npt.NDArray[np.floating], rate: float, name: str, source: str) -> SpeechRecording:
        """Of samples (S,), full scale 1, at any rate; ``source`` is what errors call them."""
        mono, playable = _checked(samples, source), _rate_to_play(rate)
        speech = _resampled(mono, rate, SAMPLE_RATE)
        check_speech(speech, source)
        return cls(name, speech, speech if playable == SAMPLE_RATE else _resampled(mono, rate, playable), playable)


def read_recording(path: Path, max_seconds: float | None = None) -> SpeechRecording:
    """A wav, flac, ogg, mp3 or video file, to animate."""
    return SpeechRecording.of(*_read(path, max_seconds), path.stem, str(path))


def check_speech(speech: npt.NDArray[np.float32], name: str) -> None:
    """Refuse speech (S,) that is too short to animate anything; silence animates a face at rest."""
    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{name}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")


def speech_of(speech: Speech, rate: float | None = None, max_seconds: float | None = None) -> SpeechRecording:
    """A recording to animate, from any form that Python has.

    Args:
        speech: a path; an open file; a data set's audio, ``{"array", "sampling_rate"}`` or ``{"bytes", "path"}``;
            samples as an array or a tensor; or a pair of samples and their rate, in either order.
        rate: sample rate of an array; a tensor's is 16 kHz if None.
        max_seconds: refuse speech that lasts longer.
    """
    if isinstance(speech, Mapping):  # audio of a data set of the Hugging Face hub, decoded or a file
        name = Path(speech["path"]).stem if speech.get("path") else "speech"
        if "array" in speech:
            # Channels come first there; lists come of data sets without a format.
            recording = speech_of(np.asarray(speech["array"]), speech["sampling_rate"], max_seconds)
        elif speech.get("bytes") is not None:
            recording = speech_of(io.BytesIO(speech["bytes"]), None, max_seconds)
        else:
            recording = speech_of(speech["path"], None, max_seconds)
        return replace(recording, name=name)
    if isinstance(speech, str | Path | tuple) or hasattr(speech, "read"):
        refuse_idle("a recording and a pair have their own", rate=rate is not None)
    if isinstance(speech, str | Path):
        return read_recording(Path(speech), max_seconds)
    if hasattr(speech, "read"):
        file = cast("IO[bytes]", speech)
        path = file.name if isinstance(getattr(file, "name", None), str) else "speech"
        with open_sound(file, path) as sound:
            return SpeechRecording.of(*_decoded(sound, path, max_seconds), Path(path).stem, path)
    if isinstance(speech, tuple):
        if len(speech) != 2:
            raise FaceDiffError("speech: expected samples and their rate, as a pair or as speech and rate=")
        first, second = cast("tuple[Any, Any]", speech)
        rate_first = isinstance(first, numbers.Real)  # NumPy's as well
        speech, rate = (second, first) if rate_first else (first, second)
    if rate is None:
        if not hasattr(speech, "detach"):  # a tensor has the models' rate, an array may have any
            raise FaceDiffError("rate: is missing; give the array's sample rate, as in animate(samples, rate=48000)")
        rate = SAMPLE_RATE
    rate = check_number("speech", "rate", rate, *SAMPLE_RATES, whole=True, remedy="give the rate in Hz")
    waveform = mono_waveform(cast("Waveform", speech), "speech")
    _check_length("speech", len(waveform) / rate, max_seconds)
    return SpeechRecording.of(waveform, rate, "speech", "speech")


def mono_waveform(samples: Waveform, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) with full scale 1 from an array or a tensor; channels, along the shorter axis, are averaged."""
    tensor: Any = samples
    if hasattr(tensor, "detach"):
        tensor = tensor.detach().cpu()
        samples = tensor.float() if tensor.is_floating_point() else tensor  # NumPy has no bfloat16
    array = np.asarray(samples)
    scale = FULL_SCALE.get(array.dtype.name)
    if (array.dtype.kind != "f" and scale is None) or array.ndim not in (1, 2) or not array.size:
        raise FaceDiffError(
            f"{name}: is {array.dtype} of shape {array.shape}; expected samples (S,) or (S, channels) in floating "
            f"point, int16, int32 or uint8, or the path of a recording"
        )
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, and is refused
        plain = (
            array.astype(np.float32)
            if scale is None
            else ((array.astype(np.float64) - scale[1]) / scale[0]).astype(np.float32)
        )
    if plain.ndim == 2:
        plain = plain.mean(axis=int(np.argmin(plain.shape)))
    return plain


def stream_piece(chunk: Waveform | bytes) -> npt.NDArray[np.float32]:
    """A piece (n,) of a stream, which may be empty."""
    odd = isinstance(chunk, bytes) and len(chunk) % 2
    samples = samples_of(chunk) if isinstance(chunk, bytes) and not odd else np.asarray(chunk)
    if samples.ndim != 1:
        shape = f"{len(chunk)} bytes" if odd else f"the shape {np.shape(chunk)}"
        raise FaceDiffError(f"chunks: one has {shape}; expected mono samples (n,), or bytes of 16-bit samples")
    return _checked(mono_waveform(samples, "chunks"), "chunks") if len(samples) else np.zeros(0, np.float32)


# Decoders return the samples that they find, and only some of them say that there should be more. A recording that was
# cut short by a full disk or a broken download would be animated as far as it goes. Programs that write to a pipe do
# not know the length; their placeholder is recognised, and such recordings are whole.

OPEN_ENDS = (range(0x7FFF_F000, 0x8000_0001), range(0xFFFF_0000, 0x1_0000_0000))
"""Sizes that programs put into a header of 32 bits when they write to a pipe (SoX and ALSA; FFmpeg)."""

CUT = "is cut short"


def refuse_cut_short(path: Path) -> None:
    """Refuse a recording that ends before its container says."""
    remark = cut_short(path)
    if remark is not None:
        raise FaceDiffError(
            f"{path}: {CUT}: {remark}; copy it again, or convert what there is with ffmpeg if that is all you want"
        )


def cut_short(path: Path) -> str | None:
    """The part that a recording lacks at its end; None if it is whole, or if its format's decoder reports it.

    Wav, AIFF, MP4 and Ogg are checked, by their headers only; others, such as flac, are left to the decoder. Of an mp3
    nothing tells how long it should be.
    """
    with path.open("rb") as stream, mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as data:
        head = data[:12]
        if head[:4] in (b"RIFF", b"RF64", b"BW64") and head[8:] == b"WAVE":
            return _chunks(data, "<4sI", b"data")
        if head[:4] in (b"RIFX", b"FORM"):
            return _chunks(data, ">4sI", b"data" if head[:4] == b"RIFX" else b"SSND")
        if head[:4] == b"OggS":
            return _ogg(data)
        if head[4:8] in (b"ftyp", b"wide", b"mdat", b"moov"):
            return _boxes(data)
        return None


def _bytes(count: int) -> str | None:
    return f"{count} bytes are missing at its end" if count > 0 else None


def _chunks(data: mmap.mmap, form: str, samples: bytes) -> str | None:
    """Wav and AIFF: chunks with a name of 4 bytes and a size each, one of which holds the samples."""
    at, large = 12, None
    while at + 8 <= len(data):
        name, size = struct.unpack_from(form, data, at)
        at += 8
        if name == b"ds64" and at + 16 <= len(data):  # the size of the samples in 64 bits, for files above 4 GiB
            large = struct.unpack_from("<Q", data, at + 8)[0]
        if name == samples:
            size = large if large is not None and size == 0xFFFF_FFFF else size
            is_open = any(size in sizes for sizes in OPEN_ENDS)
            return None if is_open else _bytes(at + size - len(data))
        at += size + size % 2
    return None


def _ogg(data: mmap.mmap) -> str | None:
    """Ogg: pages, of which the last one is marked."""
    at, last = 0, False
    while at + 27 <= len(data):
        if data[at : at + 4] != b"OggS":
            at = data.find(b"OggS", at)
            if at < 0:  # other things follow the last page
                break
            continue
        segments = data[at + 27 : at + 27 + data[at + 26]]
        end = at + 27 + data[at + 26] + sum(segments)
        if len(segments) < data[at + 26] or end > len(data):
            return "its last page is incomplete"
        last, at = bool(data[at + 5] & 4), end
    return None if last else "its last page is missing"


def _boxes(data: mmap.mmap) -> str | None:
    """MP4 and QuickTime: boxes with a size and a name each; one of size 0 reaches to the end."""
    at = 0
    while at + 8 <= len(data):
        size = struct.unpack_from(">I", data, at)[0]
        if size == 1 and at + 16 <= len(data):
            size = struct.unpack_from(">Q", data, at + 8)[0]
        if size < 8:
            return None
        at += size
    return _bytes(at - len(data))
