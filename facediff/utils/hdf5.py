"""HDF5 files of FLAME reconstructions: named datasets (1, T, D), read by the optional h5py.

EMOTE (Daněček et al. 2023, the inferno repository) writes them flat; older files were written by hickle, which puts
them into the group ``data`` and quotes their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged, needs_extra

HDF5_SUFFIXES = (".hdf5", ".h5")
ROTATION = 3
"""Columns of a rotation, of which none may be left out."""

Array = npt.NDArray[np.float64]


def read_frames(path: Path, widths: Mapping[str, int]) -> dict[str, Array]:
    """Datasets of a file by name, each (T, D) float64, with ``widths`` columns at most; rotations have exactly 3."""
    with needs_extra("h5py", "prepare", "reading FLAME reconstructions (.hdf5)"):
        import h5py
    remedy = f"expected {', '.join(widths)} as in shape_pose_cam.hdf5; get the file again if it is truncated"
    with damaged(path, remedy, OSError, RuntimeError), h5py.File(path, "r") as file:
        holder = file if "exp" in file else file.get("data", file)
        # hickle keeps the quotes of a key as part of its name.
        names = {name.strip("\"'"): name for name in holder}
        frames = {}
        for name, width in widths.items():
            dataset = holder[names[name]]
            # A file from elsewhere must not make facediff read other files of this machine.
            if dataset.file.filename != file.filename or dataset.external or dataset.is_virtual:
                raise ValueError(f"{name} lies in another file")
            frames[name] = as_frames(dataset[()], width, f"{path}: {name}", exact=width == ROTATION)
        return frames


def as_frames(values: npt.NDArray[np.generic], columns: int, where: str, *, exact: bool) -> Array:
    """(T, D) from (1, T, D), the way in which these projects keep a batch of one; ``where`` names it in messages.

    There are exactly so many columns, or at most: the last coefficients of shape and expression may be left out.
    """
    frames = values[0] if values.ndim == 3 and len(values) == 1 else values
    fits = frames.dtype.kind in "fiu" and frames.ndim == 2 and len(frames)
    if not fits or not (columns if exact else 1) <= frames.shape[1] <= columns:
        raise FaceDiffError(
            f"{where} has shape {values.shape} of {values.dtype}; expected (1, frames, {'' if exact else 'up to '}"
            f"{columns}) of numbers, with at least one frame"
        )
    return frames.astype(np.float64)
