"""Files of motion in parameters, read by their suffix and header."""

from __future__ import annotations

from pathlib import Path

from facediff.errors import check_known, refuse_idle
from facediff.spaces.files.arrays import read_array, write_array
from facediff.spaces.files.beat import read_beat, write_beat
from facediff.spaces.files.clips import ParameterClip
from facediff.spaces.files.csv_files import COUNT, REMEDY, read_audio2face, read_live_link, write_live_link
from facediff.utils.hdf5 import HDF5_SUFFIXES
from facediff.utils.paths import from_home
from facediff.utils.plain_files import read_columns

ARRAYS = (".npy", ".npz", ".pt", *HDF5_SUFFIXES)
"""Files of arrays, which need a declared layout."""
SUFFIXES = (".csv", ".json", *ARRAYS)


def read_parameters(path: str | Path, *, layout: str | None = None, frame_rate: float | None = None) -> ParameterClip:
    """Read a recording in parameters.

    Args:
        path: a ``.csv`` of Live Link Face or Audio2Face, a ``.json`` of BEAT or LAM, a ``.npy``, ``.npz`` or
            ``.pt``, or 3DMEAD's ``.hdf5``.
        layout: name of the layout of a ``.npy``, ``.npz`` or ``.pt``, which does not say it; other files name their
            columns.
        frame_rate: frames a second of an array, where its layout states none.
    """
    path = Path(from_home(path))
    suffix = path.suffix.lower()
    check_known(path, "format", [suffix], SUFFIXES)
    if suffix in ARRAYS:
        return read_array(path, layout, frame_rate)
    refuse_idle(f"{path} names its columns itself", layout=layout is not None)
    if suffix == ".json":
        return read_beat(path)
    is_live_link = COUNT in read_columns(path, (COUNT,), remedy=REMEDY)[0]
    return read_live_link(path) if is_live_link else read_audio2face(path)


def write_parameters(path: str | Path, clip: ParameterClip, *, layout: str = "") -> None:
    """Write a recording in parameters; it appears whole or not at all.

    Args:
        path: the suffix chooses the format: ``.csv``, ``.json`` (BEAT's), ``.npy`` or ``.npz``.
        clip: the recording.
        layout: of a ``.npy`` or ``.npz``; the clip's own if empty.
    """
    path = Path(path)
    suffix = path.suffix.lower()
    check_known(path, "format", [suffix], (".csv", ".json", ".npy", ".npz"))
    if suffix == ".csv":
        write_live_link(path, clip)
    elif suffix == ".json":
        write_beat(path, clip)
    else:
        write_array(path, clip, layout)
