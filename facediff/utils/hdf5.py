"""HDF5 files of FLAME reconstructions: named datasets (1, T, D), read by the optional h5py.

EMOTE (Daněček et al. 2023, the inferno repository) writes them flat; older files were written by hickle, which puts
them into the group ``data`` and quotes their names.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, needs_extra

if TYPE_CHECKING:
    import h5py

HDF5_SUFFIXES = (".hdf5", ".h5")
MOST_FRAMES = 1_000_000
ROTATION = 3
"""Columns of a rotation, of which none may be left out."""

Array = npt.NDArray[np.float64]


def read_frames(path: Path, widths: Mapping[str, int]) -> dict[str, Array]:
    """Datasets of a file by name, each (T, D) float64; the file may have others.

    Args:
        path: the file.
        widths: names of the datasets, with the most columns that each may have; rotations (3) have exactly so many.

    Raises:
        MissingExtraError: if h5py is not installed.
        FaceDiffError: if the file lacks one, is damaged, or its numbers lie in another file.
    """
    with needs_extra("h5py", "prepare", "reading FLAME reconstructions (.hdf5)"):
        import h5py
    try:
        with h5py.File(path, "r") as file:
            holder = file if "exp" in file else file.get("data", file)
            if holder.file.filename != file.filename:
                raise FaceDiffError(f"{path}: its data lie in another file; expected a file that holds its own data")
            # hickle keeps the quotes of a key as part of its name.
            names = {name.strip("\"'"): name for name in holder} if isinstance(holder, h5py.Group) else {}
            absent = [name for name in widths if name not in names]
            if absent:
                raise FaceDiffError(
                    f"{path}: has no {', '.join(absent)} (it has {', '.join(sorted(names)) or 'nothing'}); expected "
                    f"{_listed(widths)}, as shape_pose_cam.hdf5 has them"
                )
            return {name: _dataset(holder, names[name], width, path) for name, width in widths.items()}
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise FaceDiffError(f"{path}: not a readable HDF5 file, perhaps truncated ({error}); get it again") from error


def _dataset(holder: h5py.Group, name: str, most: int, path: Path) -> Array:
    import h5py

    where = f"{path}: {name}"
    link, dataset = holder.get(name, getlink=True), holder.get(name)
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
        raise FaceDiffError(f"{where} holds no numbers; expected floats of shape (1, frames, up to {most})")
    # A file from elsewhere must not make facediff read other files of this machine.
    elsewhere = isinstance(link, h5py.ExternalLink) or dataset.file.filename != holder.file.filename
    if elsewhere or dataset.external or dataset.is_virtual:
        raise FaceDiffError(f"{where} lies in another file; expected a file that holds its own data")
    if max(dataset.shape, default=0) > MOST_FRAMES:
        raise FaceDiffError(f"{where} has shape {dataset.shape}; expected at most {MOST_FRAMES} frames")
    return as_frames(dataset[()], most, where, exact=most == ROTATION)


def as_frames(values: npt.NDArray[np.generic], most: int, where: str, *, exact: bool) -> Array:
    """(T, D) from (1, T, D), the way in which these projects keep a batch of one.

    Args:
        values: as the file has them.
        most: most columns.
        where: what messages call them.
        exact: whether there are exactly so many; of shape and expression, the last coefficients may be left out.
    """
    frames = values[0] if values.ndim == 3 and len(values) == 1 else values
    if frames.ndim != 2 or not len(frames) or not (most if exact else 1) <= frames.shape[1] <= most:
        raise FaceDiffError(
            f"{where} has shape {values.shape}; expected (1, frames, {'' if exact else 'up to '}{most}) with at least "
            f"one frame"
        )
    return frames.astype(np.float64)


def _listed(names: Mapping[str, int]) -> str:
    *others, last = names
    return f"{', '.join(others)} and {last}" if others else last
