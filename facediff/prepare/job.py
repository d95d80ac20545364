"""What preparing a corpus consists of: the clips to write, and how their files are written."""

from __future__ import annotations

import pickle  # noqa: S403 - writes a pickle, opens none
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.files import atomic

Precision = Literal["float32", "float64"]
"""How motion is stored; float32 takes half the disk."""

CLIP_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,199}")


@dataclass(frozen=True)
class Job:
    """One clip to write.

    Attributes:
        name: the clip's name, e.g. ``F2_e01``.
        work: gets the output folder, writes ``vertices_npy/<name>.npy`` and ``wav/<name>.wav``, each atomically, and
            returns the number of frames. Must be picklable: a ``functools.partial`` of a function of a module.
        frames: number of frames if that is known cheaply, for the estimate of the disk space.

    Raises:
        FaceDiffError: if the name is unfit for a file name; names come from raw data and must not leave the folder.
    """

    name: str
    work: Callable[[Path], int]
    frames: int | None = None

    def __post_init__(self) -> None:
        if not CLIP_NAME.fullmatch(self.name):
            raise FaceDiffError(
                f'clip name "{self.name}": expected letters, digits, "_" and "-" only; rename it in the raw data'
            )


@dataclass(frozen=True)
class Plan:
    """What there is to do, made by a quick scan of the raw folder.

    Attributes:
        corpus: ``biwi``, ``vocaset`` or ``mead3d``.
        frame_rate: motion frames a second, as written.
        unit: unit of the written vertices.
        n_vertices: vertices of every frame.
        options: plain values that decide what is written, ``dtype`` among them; a resumed run must have the same.
        jobs: one for each clip.
        shared: writes what clips share (``templates.pkl``, mesh, ``regions/``, ``clips.csv``) and returns the paths of
            those files, relative to the output folder. Runs in the calling process; may run again.
        missing: what is not there: clip or file, and what was expected where.
        notes: other remarks for the user, one sentence each.
    """

    corpus: str
    frame_rate: float
    unit: str
    n_vertices: int
    options: dict[str, Any]
    jobs: list[Job]
    shared: Callable[[Path], list[str]]
    missing: dict[str, str] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)


def motion_file(out: Path, clip: str) -> Path:
    """Where a clip's vertices go."""
    return out / "vertices_npy" / f"{clip}.npy"


def speech_file(out: Path, clip: str) -> Path:
    """Where a clip's speech goes."""
    return out / "wav" / f"{clip}.wav"


def write_motion(path: Path, vertices: npt.NDArray[np.floating], dtype: Precision = "float32") -> None:
    """Write absolute vertices (T, V, 3) as a (T, 3V) array, atomically.

    Raises:
        FaceDiffError: if there is no frame, a value is not finite, or the file cannot be written.
    """
    frames = len(vertices)
    if not frames:
        raise FaceDiffError(f"{path.stem}: has no frame; expected at least one")
    finite = np.isfinite(vertices).reshape(frames, -1).all(axis=1)
    if not finite.all():
        raise FaceDiffError(
            f"{path.stem}: frame {int(np.argmin(finite))} (counted from 0) holds NaN or infinity; leave the clip out "
            f"or get it anew"
        )
    rows = np.ascontiguousarray(vertices.reshape(frames, -1), dtype=dtype)
    with atomic(path) as temporary:
        np.save(temporary, rows, allow_pickle=False)


def write_speech(path: Path, speech: npt.NDArray[np.floating]) -> None:
    """Write speech (S,) in -1 … 1 as 16 kHz mono 16-bit wav, atomically; what exceeds the range is clipped.

    Reading it back gives ``round(32768 x) / 32768``: 16-bit speech at 16 kHz goes through unchanged.
    """
    try:
        import soundfile
    except ImportError as error:
        raise MissingExtraError("soundfile", "audio", "writing speech") from error
    from facediff.data.audio import SAMPLE_RATE

    whole = np.clip(np.rint(np.asarray(speech, np.float64) * 32768), -32768, 32767).astype(np.int16)
    with atomic(path) as temporary:
        soundfile.write(temporary, whole, SAMPLE_RATE, subtype="PCM_16")


def write_templates(path: Path, templates: Mapping[str, npt.NDArray[np.floating]]) -> None:
    """Write neutral faces (V, 3) by subject as the pickle of NumPy arrays that the field's loaders open.

    Equal faces give equal bytes: each array gets NumPy's own instance of its type, because a pickle also records which
    arrays share a type's instance, and that depends on where they came from.
    """
    plain: dict[str, npt.NDArray[np.floating]] = {}
    for name, vertices in templates.items():
        plain[str(name)] = np.empty(vertices.shape, np.dtype(vertices.dtype.str))
        plain[str(name)][...] = vertices
    with atomic(path) as temporary:
        temporary.write_bytes(pickle.dumps(plain, protocol=4))
