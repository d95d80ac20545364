"""Speech in every form that Python and the command line give it in, as samples (S,) at 16 kHz; needs no PyTorch."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, OptionError
from facediff.speech.audio import read_sound, read_speech, to_speech
from facediff.speech.pcm import samples_of
from facediff.utils import SAMPLE_RATE
from facediff.utils.limits import LIMITS, SAMPLE_RATES, check_number

if TYPE_CHECKING:
    from torch import Tensor

    Waveform: TypeAlias = npt.NDArray[np.generic] | Tensor
    Speech: TypeAlias = (
        str | Path | IO[bytes] | Mapping[str, Any] | Waveform | tuple[Waveform, int] | tuple[int, Waveform]
    )

MIN_SECONDS = 0.2
FULL_SCALE = {"uint8": (128.0, 128), "int16": (32768.0, 0), "int32": (2.0**31, 0)}
"""What whole numbers are divided by to get a full scale of 1, and where they have silence; as .wav files hold them."""


def read_recording(path: Path, max_seconds: float | None = None) -> npt.NDArray[np.float32]:
    """Speech (S,) of a wav, flac, ogg, mp3 or video file."""
    speech = read_speech(path, max_seconds=max_seconds)
    check_speech(speech, str(path))
    return speech


def check_speech(speech: npt.NDArray[np.float32], name: str) -> None:
    """Refuse speech (S,) that is too short to animate anything; silence animates a face at rest."""
    seconds = len(speech) / SAMPLE_RATE
    if seconds < MIN_SECONDS:
        raise FaceDiffError(f"{name}: lasts {seconds:.2f} s; expected speech of at least {MIN_SECONDS} s")


def speech_of(
    speech: Speech, rate: float | None = None, max_seconds: float | None = None
) -> tuple[npt.NDArray[np.float32], str]:
    """Samples (S,) and a name, from whatever one recording may be given as.

    Args:
        speech: a path; an open file; a data set's audio, ``{"array", "sampling_rate"}`` or ``{"bytes", "path"}``;
            samples as an array or a tensor; or a pair of samples and their rate, in either order.
        rate: sample rate of an array; that of a tensor is 16 kHz if None.
        max_seconds: refuse speech that lasts longer.
    """
    if isinstance(speech, Mapping):
        return _of_data_set(speech, rate, max_seconds)
    if isinstance(speech, str | Path) or hasattr(speech, "read"):
        if rate is not None:
            raise FaceDiffError(f"rate {rate:g}: belongs to an array, and {speech} says its own; omit it")
        if isinstance(speech, str | Path):
            return read_recording(Path(speech), max_seconds), Path(speech).stem
        file = cast("IO[bytes]", speech)
        path = file.name if isinstance(getattr(file, "name", None), str) else "speech"
        samples = read_sound(file, path, max_seconds=max_seconds)
        check_speech(samples, path)
        return samples, Path(path).stem
    if isinstance(speech, tuple):
        if rate is not None or len(speech) != 2:
            raise FaceDiffError("speech: expected samples and their rate, as a pair or as speech and rate=")
        first, second = cast("tuple[Any, Any]", speech)
        speech, rate = (second, first) if isinstance(first, int | float) else (first, second)
    if rate is None:
        if not hasattr(speech, "detach"):  # a tensor has the models' rate, an array may have any
            raise FaceDiffError("rate: is missing; give the array's sample rate, as in animate(samples, rate=48000)")
        rate = SAMPLE_RATE
    rate = check_number("speech", "rate", rate, *SAMPLE_RATES, remedy="give the rate in Hz")
    waveform = mono_waveform(cast("Waveform", speech), "speech")
    seconds = len(waveform) / rate
    if max_seconds is not None and seconds > max_seconds:
        raise OptionError("max_seconds", f"speech lasts {seconds:.0f} s; cut it or raise the limit", f"{max_seconds:g}")
    LIMITS.check("seconds", seconds, "speech")
    samples = to_speech(waveform, rate, "speech")
    check_speech(samples, "speech")
    return samples, "speech"


def _of_data_set(
    audio: Mapping[str, Any], rate: float | None, max_seconds: float | None
) -> tuple[npt.NDArray[np.float32], str]:
    """Speech as data sets of the Hugging Face hub hold it: decoded, or a file's content and name."""
    name = Path(audio["path"]).stem if audio.get("path") else "speech"
    if rate is not None:
        raise FaceDiffError(f"rate {rate:g}: belongs to an array, and the data set's audio says its own; omit it")
    if "array" in audio and "sampling_rate" in audio:
        # Channels come first there; lists come of data sets without a format.
        return speech_of(np.asarray(audio["array"]), audio["sampling_rate"], max_seconds)[0], name
    if audio.get("bytes") is not None:
        return speech_of(io.BytesIO(audio["bytes"]), None, max_seconds)[0], name
    if audio.get("path"):
        return speech_of(audio["path"], None, max_seconds)
    raise FaceDiffError(
        f"speech: is a mapping with {', '.join(map(str, audio)) or 'nothing'}; expected array and sampling_rate, or "
        f"bytes or path"
    )


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
    """A piece (n,) of a stream, which may be empty.

    Raises:
        FaceDiffError: if it has several channels, holds samples that are not finite, or is of another kind.
    """
    if isinstance(chunk, bytes):
        if len(chunk) % 2:
            raise FaceDiffError(f"chunks: one has {len(chunk)} bytes, half a sample too much; give 16-bit samples")
        return samples_of(chunk)
    if np.ndim(chunk) != 1:
        raise FaceDiffError(f"chunks: one has the shape {np.shape(chunk)}; expected mono samples (n,)")
    if not len(chunk):
        return np.zeros(0, np.float32)
    samples = mono_waveform(chunk, "chunks")
    if not np.isfinite(samples).all():
        raise FaceDiffError("chunks: one holds samples that are not finite numbers; give a full scale of 1")
    return samples
