"""Reading speech, in every form that Python and the command line give it in, as samples (S,) at 16 kHz.

From top to bottom: files; stretches of a corpus's files; recordings to animate; pieces of a stream; and whether a file
is whole.
"""

from __future__ import annotations

import io
import math
import mmap
import numbers
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError, OptionError, needs_extra, note, refuse_idle
from facediff.speech.pcm import samples_of
from facediff.speech.voice_activity import NOISY, loudness_range
from facediff.utils import SAMPLE_RATE as SAMPLE_RATE
from facediff.utils.arrays import ArrayStore
from facediff.utils.hints import check_number
from facediff.utils.limits import SAMPLE_RATES, brief
from facediff.utils.paths import from_home

if TYPE_CHECKING:
    from torch import Tensor

    Waveform: TypeAlias = npt.NDArray[np.generic] | Tensor
    Speech: TypeAlias = (
        str | Path | IO[bytes] | Mapping[str, Any] | Waveform | tuple[Waveform, int] | tuple[int, Waveform]
    )

Samples = npt.NDArray[np.float32]

SUFFIXES = (".wav", ".flac", ".ogg", ".mp3", ".opus", ".aiff")
VIDEOS = (".mp4", ".mov", ".m4v", ".mkv", ".webm", ".avi", ".flv", ".mpg", ".mpeg", ".ts", ".mts", ".wmv", ".3gp")
CONTAINERS = (*VIDEOS, ".m4a", ".aac")
"""Videos and similar containers; PyAV extracts their sound."""
RECORDINGS = (*SUFFIXES, ".m4a", ".aac")
"""Files that hold sound alone."""

DEMUXERS = "flv,mov,mp4,m4a,matroska,webm,avi,asf,aac,ac3,eac3,amr,mpegts,mpeg,mp3,ogg,wav,flac,aiff,au,w64,caf"
"""What FFmpeg may take such a file for: not a playlist, which names other files and addresses to be opened."""

LOUDEST = 2.0**31
"""Largest sample: of whole numbers of 32 bits that were not scaled to 1."""

BLOCK = 1 << 18
"""Samples of all channels together that are decoded at a time."""

HOLE = 0.05
"""Seconds by which the times of packets may jump before sound counts as lost, or as there twice."""

LONGEST_HOLE = 600.0
"""Seconds of sound that may be missing; a longer jump is a damaged time, or another recording."""

RESTART = 1.0
"""Seconds by which times go back where another recording begins."""

STEP = 4096
"""Samples over which channels may cancel."""

CANCELLATION, LOSS = 0.6, 0.1
"""Share of the energy of unrelated channels below which channels cancel, and of all energy that may be lost so."""

SILENCE = 1e-4
"""Share of the loudest channel's energy below which a channel has no sound."""

OVERSHOOT, WHOLE_NUMBERS = 1.5, 8.0
"""Peaks that lossy codecs and resampling reach, and above which samples are whole numbers."""

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
    """Read a recording, or the sound of a video, as (S,) float32 mono at 16 kHz, by its content, whatever its name.

    Channels are averaged, as :func:`mono` does; another rate is resampled by soxr (high quality). Decoding ends where
    the speech becomes longer than ``max_seconds``.
    """
    return to_speech(*_read(path, str(path), max_seconds), str(path))


def _read(source: Path | IO[bytes], name: str, max_seconds: float | None) -> tuple[npt.NDArray[np.float32], int]:
    """Mono samples (S,) of a file and their rate, by libsndfile or, where that knows no such content, by PyAV."""
    with _open_stream(source, name) as stream:
        stream.seek(0)
        refuse_cut_short(stream, name)
        try:
            with open_sound(stream, name) as sound:
                readable = sound.frames > 0  # a header that was never completed tells none; PyAV reads what follows
        except FaceDiffError as error:
            readable, refusal = False, error
        else:
            refusal = FaceDiffError(f"{name}: holds no samples; expected speech")
        stream.seek(0)
        if not readable:
            return _decode_container(stream, name, max_seconds, refusal)
        with open_sound(stream, name) as sound:
            try:
                samples, rate = _decoded(sound, name, max_seconds)
            except LostSamplesError as error:
                if sound.format != "OGG":
                    raise
                refusal = error
            else:
                return _from_zero(samples, rate, stream, name, max_seconds), rate
        return _decode_container(stream, name, max_seconds, refusal)  # times of packets tell where it has holes


def _from_zero(samples: Samples, rate: int, stream: IO[bytes], name: str, limit: float | None) -> Samples:
    """The same; of an Ogg file with silence for the beginning that it lacks by the time at which its last page ends."""
    stream.seek(0)
    with _map_content(stream) as data:
        late = round(_ogg_end(data) * rate) - len(samples)
    if not HOLE * rate < late <= LONGEST_HOLE * rate:
        return samples
    _check_length(name, (late + len(samples)) / rate, limit)
    note(f"{name}: {late / rate:.2f} s of its sound are missing by its times, and are silence")
    return np.pad(samples, (late, 0))


class LostSamplesError(FaceDiffError):
    """A file has fewer samples than it declares."""


@contextmanager
def _open_stream(source: Path | IO[bytes], name: str) -> Iterator[IO[bytes]]:
    """A file as a stream of bytes: a library that opens it by itself would go by its name and by files beside it."""
    if not isinstance(source, Path):
        yield source if getattr(source, "seekable", lambda: False)() else io.BytesIO(source.read())
        return
    if not source.is_file() or source.stat().st_size == 0:
        raise FaceDiffError(
            f"{name}: no such sound file, or an empty one; expected speech as {', '.join(SUFFIXES + CONTAINERS)}"
        )
    with source.open("rb") as stream:
        yield stream


def write_wav(path: Path, samples: npt.NDArray[Any], rate: int, bits: int = 16) -> None:
    """Write samples (S,) or (S, channels) as a .wav; libsndfile itself would not say that the disk is full."""
    import soundfile

    sound = io.BytesIO()
    soundfile.write(sound, samples, rate, format="WAV", subtype=f"PCM_{bits}")
    path.write_bytes(sound.getvalue())


def to_speech(samples: npt.NDArray[np.floating], rate: float, name: str) -> npt.NDArray[np.float32]:
    """Samples (S,) or (S, channels), full scale 1, at any rate as (S',) float32 mono at 16 kHz."""
    return _resampled(_checked(samples, name), rate, SAMPLE_RATE)


def _checked(samples: npt.NDArray[np.floating], name: str) -> npt.NDArray[np.floating]:
    """Mono, where all samples are in range; whole numbers that were made floating point are scaled to 1."""
    peak = float(np.maximum(samples.max(initial=0.0), -samples.min(initial=0.0)))  # without a copy of all samples
    if not len(samples) or not peak <= LOUDEST:
        raise FaceDiffError(
            f"{name}: holds no samples, or up to {peak:g}; expected speech of finite numbers with a full scale of 1"
        )
    if peak > 1.001:
        scale = next(full for full in (2.0**15, 2.0**23, LOUDEST) if peak <= full) if peak > WHOLE_NUMBERS else peak
        if peak > OVERSHOOT:
            note(f"{name}: its samples reach {peak:g} where full scale is 1; they are divided by {scale:g}")
        samples = samples / np.float32(scale)
    return samples if samples.ndim == 1 else mono(lambda: iter([samples]), name)


def mono(
    blocks: Callable[[], Iterator[npt.NDArray[np.floating]]],
    name: str,
    length: int | None = None,
    say: Callable[[str], None] = note,
) -> Samples:
    """The mean (S,) of the channels that have any sound; the loudest channel alone where they cancel each other.

    Args:
        blocks: gives the samples (n, channels) of each block in order, and again from the beginning when called again.
        name: of the recording in the note on channels that cancel.
        length: number of all samples, where it is known: a long recording then fits once into memory, not twice.
        say: takes that note.
    """
    energy, spent, lost = np.zeros(1), 0.0, 0.0

    def mean(block: npt.NDArray[np.floating]) -> npt.NDArray[np.floating]:
        nonlocal energy, spent, lost
        if block.shape[1] == 1:
            return block[:, 0]
        mixed: npt.NDArray[np.floating] = block.mean(axis=1)
        starts = np.arange(0, len(block), STEP)
        each = np.add.reduceat(np.square(block, dtype=np.float64), starts, axis=0)
        together = np.add.reduceat(np.square(mixed, dtype=np.float64), starts) * block.shape[1] ** 2
        energy, unrelated = energy + each.sum(axis=0), each.sum(axis=1)
        spent, lost = spent + float(unrelated.sum()), lost + float(unrelated[together < CANCELLATION * unrelated].sum())
        return mixed

    samples = _join(map(mean, blocks()), length)
    if lost > LOSS * spent:
        loudest = int(energy.argmax())
        say(f"{name}: its channels cancel each other; channel {loudest + 1} alone is taken")
        return _join((block[:, loudest] for block in blocks()), length)
    with_sound = int((energy > SILENCE * energy.max()).sum())
    return samples if with_sound in (0, len(energy)) else samples * np.float32(len(energy) / with_sound)


def _join(pieces: Iterable[npt.NDArray[np.floating]], length: int | None) -> Samples:
    if length is None:
        parts = [np.array(piece, np.float32) for piece in pieces]
        return np.concatenate(parts) if parts else np.zeros(0, np.float32)
    samples, filled = np.empty(length, np.float32), 0
    for piece in pieces:
        samples[filled : filled + len(piece)] = piece
        filled += len(piece)
    return samples


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

    name = name or str(source)
    try:
        with _open_stream(source, name) as stream, soundfile.SoundFile(stream) as file:
            yield file
    except (soundfile.LibsndfileError, RuntimeError, TypeError, ValueError, OSError) as error:
        raise FaceDiffError(
            f"{name}: not a readable sound file ({_reason(name, error)}); "
            f"expected one of {', '.join(SUFFIXES + CONTAINERS)}"
        ) from error


def _reason(name: str, error: Exception) -> str:
    """A library's message about a file, without the name that begins it already."""
    return brief(re.sub(r"Error opening <.*?>: ", "", str(error)).replace(name, Path(name).name))


def _decoded(file: Any, name: str, limit: float | None) -> tuple[Samples, int]:  # noqa: ANN401
    """All samples (S,) of a ``soundfile.SoundFile``."""
    declared, rate = int(file.frames), int(file.samplerate)
    counted_frames = 0 <= declared < UNKNOWN
    is_estimate = file.subtype.startswith("MPEG")  # unless a frame of an mp3 tells the number of frames
    _check_length(name, declared / rate if counted_frames else 0, limit)

    def blocks() -> Iterator[npt.NDArray[np.float32]]:
        decoded = 0
        if file.tell():
            file.seek(0)
        while len(block := file.read(max(1, BLOCK // file.channels), dtype="float32", always_2d=True)):
            decoded += len(block)
            _check_length(name, decoded / rate, limit)
            yield block
        if counted_frames and decoded < declared and not is_estimate:
            raise LostSamplesError(
                f"{name}: is cut short or damaged: {decoded} of {declared} samples can be decoded; copy it again"
            )

    is_known = file.format in LENGTH_IS_KNOWN and counted_frames and not is_estimate
    return mono(blocks, name, declared if is_known else None), rate


def _decode_container(stream: IO[bytes], name: str, limit: float | None, refusal: FaceDiffError) -> tuple[Samples, int]:
    """The sound track of a container in which there is a voice, (S,) mono, from the time of its first picture on.

    ``refusal`` is the error where FFmpeg knows no such content either.
    """
    try:
        with needs_extra("av", "prepare", f"extracting the sound of {Path(name).suffix} files"):
            import av
    except MissingExtraError as error:
        raise (error if Path(name).suffix.lower() in CONTAINERS else refusal) from error

    def open_container() -> Any:  # noqa: ANN401
        stream.seek(0)
        return av.open(stream, options={"format_whitelist": DEMUXERS})

    tracks: list[tuple[float, Samples, list[str]]] = []
    try:
        with open_container() as container:
            rates = [int(track.rate) for track in container.streams.audio]
        if not rates:
            raise FaceDiffError(f"{name}: has no sound track; expected a video with speech")
        for number, rate in enumerate(rates):
            notes: list[str] = []
            samples = mono(partial(_track, open_container, number, name, limit, notes.append), name, say=notes.append)
            clear = loudness_range(_resampled(samples, rate, SAMPLE_RATE)) if len(rates) > 1 else math.inf
            tracks.append((clear, samples, notes))
            if clear >= NOISY:
                break
    except (av.FFmpegError, AttributeError, ValueError, TypeError, OSError) as error:  # a track may lack its rate
        if Path(name).suffix.lower() not in CONTAINERS:
            raise refusal from error
        raise FaceDiffError(f"{name}: its sound cannot be read ({_reason(name, error)}); convert it to .wav") from error
    best = max(range(len(tracks)), key=lambda number: tracks[number][0])
    _, samples, notes = tracks[best]
    if best:
        notes.append(f"{name}: its sound track {best + 1} of {len(rates)} is taken, in which the voice is clearest")
    for remark in dict.fromkeys(notes):
        note(remark)
    return samples, rates[best]


def _track(
    open_container: Callable[[], Any], number: int, name: str, limit: float | None, say: Callable[[str], None]
) -> Iterator[npt.NDArray[np.float32]]:
    """Samples (n, channels) of a sound track, with silence where its packets' times jump."""
    done, start, in_step, faults = 0, None, False, Counter[str]()
    with open_container() as container:
        track = container.streams.audio[number]
        rate = int(track.rate)
        if track.duration and track.time_base:
            _check_length(name, float(track.duration * track.time_base), limit)
        for frame in container.decode(track):
            samples, channels = _to_full_scale(frame.to_ndarray()), frame.layout.nb_channels
            block = samples.T if frame.format.is_planar else samples.reshape(-1, channels)
            if frame.time is not None:
                start = _first_time(container, frame.time) if start is None else start
                ahead = round((frame.time - start) * rate) - done  # of the samples so far
                if done and ahead < -RESTART * rate:
                    say(f"{name}: the times of its sound begin anew at {done / rate:.2f} s; what comes there follows")
                    start, ahead = frame.time - done / rate, 0
                if ahead > LONGEST_HOLE * rate:
                    raise FaceDiffError(
                        f"{name}: its sound stops at {done / rate:.1f} s and goes on {ahead / rate:.0f} s later; "
                        f"cut it there, or convert it to .wav"
                    )
                if not in_step or abs(ahead) > HOLE * rate:  # what follows stays in step with the pictures
                    _check_length(name, (done + ahead) / rate, limit)
                    if ahead > HOLE * rate:
                        faults["are missing by its times, and are silence"] += ahead
                    elif done:
                        faults["have the times of sound before them, and are left out"] += min(-ahead, len(block))
                    if ahead > 0:
                        yield np.zeros((ahead, channels), np.float32)
                        done += ahead
                    block = block[max(0, -ahead) :]
                    in_step = len(block) > 0
            done += len(block)
            yield block
            _check_length(name, done / rate, limit)
    for fault, count in faults.items():
        say(f"{name}: {count / rate:.2f} s of its sound {fault}")


def _first_time(container: Any, sound: float) -> float:  # noqa: ANN401 - PyAV's
    """The time of the first picture; of a file without pictures the zero of its clock, or the sound's own beginning."""
    if container.streams.video:
        pictures = container.streams.video[0]
        return float((pictures.start_time or 0) * pictures.time_base)
    zero_based = {"mp4", "matroska", "ogg"} & {*container.format.name.split(",")} and sound < LONGEST_HOLE
    return 0.0 if zero_based else sound


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
    with suppress(FaceDiffError), open_sound(path) as file:
        # Samples in floating point may go beyond 1, by which all of them are divided; an Ogg may have holes.
        is_plain = file.channels == 1 and file.seekable() and file.subtype not in ("FLOAT", "DOUBLE", "VORBIS", "OPUS")
        if is_plain and file.samplerate == SAMPLE_RATE and file.frames:
            file.seek(min(first, file.frames))
            return fit_length(file.read(length, dtype="float32"), length)
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


def denoised(speech: Samples) -> Samples:
    """Speech (S,) at 16 kHz without its steady noise, by spectral gating; silence stays silence."""
    with needs_extra("noisereduce", "voice", "--denoise"):
        import noisereduce
    if not speech.any():
        return speech
    cleaned = noisereduce.reduce_noise(y=speech, sr=SAMPLE_RATE, stationary=True)
    return fit_length(np.nan_to_num(np.asarray(cleaned, np.float32)), len(speech))


def samples_for(frames: int, frame_rate: float) -> int:
    """Number of 16 kHz samples that span ``frames`` motion frames."""
    return round(frames * SAMPLE_RATE / frame_rate)


@dataclass(frozen=True, eq=False)
class SpeechRecording:
    """A recording to animate.

    Attributes:
        speech: (S,) float32 mono at 16 kHz, which models hear.
        sound: (N,) float32 mono, which is played and written with the animation.
        rate: sample rate of the sound in Hz.
        path: of its file; empty if there is none.
    """

    name: str
    speech: npt.NDArray[np.float32]
    sound: npt.NDArray[np.float32]
    rate: int
    path: str = ""

    @property
    def seconds(self) -> float:
        """Duration of the speech."""
        return len(self.speech) / SAMPLE_RATE

    @classmethod
    def of(cls, samples: npt.NDArray[np.floating], rate: float, name: str, source: str) -> SpeechRecording:
        """Of samples (S,), full scale 1, at any rate; ``source`` is what errors call them."""
        mono, playable = _checked(samples, source), int(min(max(rate, SAMPLE_RATE), PLAYED))
        speech = _resampled(mono, rate, SAMPLE_RATE)
        if len(speech) < MIN_SECONDS * SAMPLE_RATE:  # silence animates a face at rest
            seconds = len(speech) / SAMPLE_RATE
            raise FaceDiffError(f"{source}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")
        return cls(name, speech, speech if playable == SAMPLE_RATE else _resampled(mono, rate, playable), playable)


def read_recording(path: Path, max_seconds: float | None = None) -> SpeechRecording:
    """A wav, flac, ogg, mp3 or video file, to animate."""
    return replace(SpeechRecording.of(*_read(path, str(path), max_seconds), path.stem, str(path)), path=str(path))


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
        return read_recording(Path(from_home(speech)), max_seconds)
    if hasattr(speech, "read"):
        file = cast("IO[bytes]", speech)
        path = file.name if isinstance(getattr(file, "name", None), str) else "speech"
        return SpeechRecording.of(*_read(file, path, max_seconds), Path(path).stem, path)
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
    samples = waveform(cast("Waveform", speech), "speech")
    _check_length("speech", len(samples) / rate, max_seconds)
    return SpeechRecording.of(samples, rate, "speech", "speech")


def waveform(samples: Waveform, name: str) -> Samples:
    """Samples (S,) or (S, channels) with full scale 1 from an array or a tensor; channels are its shorter axis."""
    tensor: Any = samples
    if hasattr(tensor, "detach"):
        tensor = tensor.detach().cpu()
        samples = tensor.float() if tensor.is_floating_point() else tensor  # NumPy has no bfloat16
    array = np.asarray(samples)
    is_sound = array.dtype.kind == "f" or array.dtype.name in FULL_SCALE
    if not is_sound or array.ndim not in (1, 2) or not array.size:
        raise FaceDiffError(
            f"{name}: is {array.dtype} of shape {array.shape}; expected samples (S,) or (S, channels) in floating "
            f"point, int16, int32 or uint8, or the path of a recording"
        )
    samples = _to_full_scale(array)
    return samples.T if samples.ndim == 2 and samples.shape[0] < samples.shape[1] else samples


def _to_full_scale(array: npt.NDArray[Any]) -> Samples:
    """Samples of any shape with a full scale of 1; floating point as it is."""
    with np.errstate(over="ignore"):  # what float32 does not hold becomes infinite, and is refused
        if array.dtype.name not in FULL_SCALE:
            return array.astype(np.float32)
        scale, silence = FULL_SCALE[array.dtype.name]
        return ((array.astype(np.float64) - silence) / scale).astype(np.float32)


def stream_piece(chunk: Waveform | bytes) -> npt.NDArray[np.float32]:
    """A piece (n,) of a stream, which may be empty."""
    odd = isinstance(chunk, bytes) and len(chunk) % 2
    samples = samples_of(chunk) if isinstance(chunk, bytes) and not odd else np.asarray(chunk)
    if samples.ndim != 1:
        shape = f"{len(chunk)} bytes" if odd else f"the shape {np.shape(chunk)}"
        raise FaceDiffError(f"chunks: one has {shape}; expected mono samples (n,), or bytes of 16-bit samples")
    if not len(samples):
        return np.zeros(0, np.float32)
    piece = waveform(samples, "chunks")
    peak = float(np.abs(piece).max())
    if WHOLE_NUMBERS < peak <= LOUDEST:  # a piece does not tell the scale of the whole stream
        raise FaceDiffError(f"chunks: one reaches {peak:g}; expected floating point with a full scale of 1, or int16")
    return piece if peak <= LOUDEST else _checked(piece, "chunks").astype(np.float32)


# Decoders return the samples that they find, and only some of them say that there should be more. A recording that was
# cut short by a full disk or a broken download would be animated as far as it goes. Programs that write to a pipe do
# not know the length; their placeholder is recognised, and such recordings are whole.

OPEN_ENDS = (range(0x7FFF_F000, 0x8000_0001), range(0xFFFF_0000, 0x1_0000_0000))
"""Sizes that programs put into a header of 32 bits when they write to a pipe (SoX and ALSA; FFmpeg)."""

CUT = "is cut short"


def refuse_cut_short(source: Path | IO[bytes], name: str = "") -> None:
    """Refuse a recording that ends before its container says."""
    remark = cut_short(source)
    if remark is not None:
        raise FaceDiffError(
            f"{name or source}: {CUT}: {remark}; copy it again, or convert what there is with ffmpeg if that is all "
            f"you want"
        )


def cut_short(source: Path | IO[bytes]) -> str | None:
    """The part that a recording lacks at its end; None if it is whole, or if its format's decoder reports it.

    Wav, AIFF, MP4 and Ogg are checked, by their headers only; others, such as flac, are left to the decoder. Of an mp3
    nothing tells how long it should be.
    """
    with _open_stream(source, str(source)) as stream, _map_content(stream) as data:
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


@contextmanager
def _map_content(stream: IO[bytes]) -> Iterator[mmap.mmap | bytes]:
    """The content of an open file."""
    try:
        data = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
    except (OSError, ValueError, AttributeError):  # it is none of the system's
        yield stream.read()
        stream.seek(0)
        return
    with data:
        yield data


def _bytes(count: int) -> str | None:
    return f"{count} bytes are missing at its end" if count > 0 else None


def _chunks(data: mmap.mmap | bytes, form: str, samples: bytes) -> str | None:
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


def _ogg(data: mmap.mmap | bytes) -> str | None:
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


def _ogg_end(data: mmap.mmap | bytes) -> float:
    """Seconds at which the first stream of an Ogg file ends by its last page; 0 if it is neither Vorbis nor Opus."""
    if data[:4] != b"OggS":
        return 0.0
    packet, at, end = 27 + data[26], len(data), -1
    while end < 0 < at:  # pages of other streams do not count, nor those on which no packet ends
        at = data.rfind(b"OggS", 0, at)
        if data[at + 14 : at + 18] == data[14:18]:
            (end,) = struct.unpack_from("<q", data, at + 6)
    head = data[packet : packet + 19]
    if head.startswith(b"OpusHead"):
        return (end - struct.unpack_from("<H", head, 10)[0]) / 48_000
    return end / max(1, struct.unpack_from("<I", head, 12)[0]) if head.startswith(b"\x01vorbis") else 0.0


def _boxes(data: mmap.mmap | bytes) -> str | None:
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
