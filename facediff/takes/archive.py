"""A take in one file: NumPy's .npz with everything that players and exporters need."""

from __future__ import annotations

import json
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.files import atomic
from facediff.takes.take import Take

FORMAT = "facediff take 1"
ARRAYS = ("vertices", "template", "faces", "speech", "colours", "inner_lip_pairs")
NEEDED = ("vertices", "template", "about")
BROKEN = (OSError, ValueError, EOFError, SyntaxError, tokenize.TokenError, zipfile.BadZipFile)
"""What NumPy raises for a damaged file; its headers are Python literals."""
SHAPES: dict[str, tuple[str, str, tuple[int | None, ...]]] = {
    "vertices": ("f", "floating point (frames, vertices, 3)", (None, None, 3)),
    "template": ("f", "floating point (vertices, 3)", (None, 3)),
    "faces": ("iu", "whole numbers (triangles, 3)", (None, 3)),
    "speech": ("f", "floating point (samples,)", (None,)),
    "colours": ("u", "bytes (vertices, 3)", (None, 3)),
    "inner_lip_pairs": ("iu", "whole numbers (pairs, 2)", (None, 2)),
}
"""What the arrays are: kinds of number, in words, and lengths of the axes."""


def write_archive(path: Path, take: Take) -> None:
    """Write a take; ``numpy.load`` opens the file without pickle.

    The entries are the arrays of :class:`Take` under their own names, ``region_<name>`` for each region, and ``about``:
    JSON with name, frame rate, unit, sample rate and metadata.

    Raises:
        FaceDiffError: if the file cannot be written, or the motion is not finite.
    """
    take.refuse_not_finite()
    arrays: dict[str, Any] = {name: getattr(take, name) for name in ARRAYS if getattr(take, name) is not None}
    arrays |= {f"region_{name}": indices for name, indices in take.regions.items()}
    about = {
        "format": FORMAT,
        "name": take.name,
        "frame_rate": take.frame_rate,
        "unit": take.unit,
        "sample_rate": take.sample_rate,
        "metadata": dict(take.metadata),
    }
    arrays["about"] = np.array(json.dumps(about, ensure_ascii=False))
    with atomic(path) as temporary, temporary.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def read_archive(path: Path) -> Take:
    """Read what :func:`write_archive` wrote.

    Raises:
        FaceDiffError: if the file is missing, broken, or no take.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected a take that `facediff animate … -o take.npz` wrote")
    held: dict[str, Any] = {**read_entries(path)}
    missing = [name for name in NEEDED if name not in held]
    if missing:
        raise FaceDiffError(
            f"{path}: has no {', '.join(missing)}; expected a take that `facediff animate … -o take.npz` wrote"
        )
    try:
        about = json.loads(str(held["about"]))
        facts: dict[str, Any] = {
            "name": str(about["name"]),
            "frame_rate": float(about["frame_rate"]),
            "unit": str(about["unit"]),
            "sample_rate": int(about["sample_rate"]),
            "metadata": {str(key): str(value) for key, value in about["metadata"].items()},
        }
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise FaceDiffError(
            f"{path}: its entry about is not what facediff writes ({error!r}); write it anew"
        ) from error
    regions = {name.removeprefix("region_"): held[name] for name in held if name.startswith("region_")}
    for name, (kinds, words, lengths) in SHAPES.items():
        if name in held:
            _refuse_other(path, name, held[name], kinds, words, lengths)
    for name, indices in {**regions, "inner_lip_pairs": held.get("inner_lip_pairs", np.zeros(0, int))}.items():
        _refuse_outside(path, name, indices, len(held["template"]))
    return Take(**{name: held[name] for name in ARRAYS if name in held}, regions=regions, **facts)


def read_entries(path: Path) -> dict[str, npt.NDArray[Any]]:
    """All arrays of an .npz file, by name.

    Raises:
        FaceDiffError: if it is no such file, damaged, or holds something else than arrays.
    """
    try:
        # Opened here, since NumPy leaves a file that it opened itself open where the archive is cut off.
        with path.open("rb") as stream:
            if not zipfile.is_zipfile(stream):
                raise ValueError("it is no archive, or was cut off")
            stream.seek(0)
            with np.load(stream, allow_pickle=False) as archive:
                held = {name: archive[name] for name in archive.files}
        strange = [name for name, value in held.items() if not isinstance(value, np.ndarray)]
        if strange:
            raise ValueError(f"{strange[0]} is no array")
    except (*BROKEN, LookupError, RuntimeError, MemoryError, zlib.error) as error:
        raise FaceDiffError(f"{path}: not a readable .npz file ({error}); write it anew") from error
    return held


def _refuse_other(
    path: Path, name: str, array: npt.NDArray[Any], kinds: str, words: str, lengths: tuple[int | None, ...]
) -> None:
    """Refuse an array of another kind or shape; one without any number may have any shape."""
    fits = array.ndim == len(lengths) and all(
        wanted in (None, length) for length, wanted in zip(array.shape, lengths, strict=True)
    )
    if array.dtype.kind not in kinds or not (fits or not array.size):
        raise FaceDiffError(
            f"{path}: its {name} are {array.dtype} of shape {array.shape}; expected {words}; write it anew"
        )


def _refuse_outside(path: Path, name: str, indices: npt.NDArray[Any], count: int) -> None:
    """Refuse indices of vertices that are not there."""
    if indices.size and (indices.dtype.kind not in "iu" or not 0 <= indices.min() <= indices.max() < count):
        raise FaceDiffError(f"{path}: its {name} names vertices other than 0 to {count - 1}; write it anew")
