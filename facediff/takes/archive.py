"""A take in one file: NumPy's .npz with everything that players and exporters need."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from facediff.errors import FaceDiffError
from facediff.files import atomic
from facediff.takes.take import Take

FORMAT = "facediff take 1"
ARRAYS = ("vertices", "template", "faces", "speech", "colours", "inner_lip_pairs")
NEEDED = ("vertices", "template", "about")


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
    try:
        # Opened here, since NumPy leaves a file that it opened itself open where the archive is cut off.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            held = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as error:
        raise FaceDiffError(f"{path}: not a readable .npz file ({error}); write it anew") from error
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
    return Take(**{name: held[name] for name in ARRAYS if name in held}, regions=regions, **facts)
