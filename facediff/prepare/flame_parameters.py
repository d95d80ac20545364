"""FLAME parameters of one clip as reconstruction projects write them: EMOTE's HDF5 files and ProbTalk3D's arrays.

EMOTE (Daněček et al. 2023, the inferno repository) has the datasets ``shape`` (1, T, 300), ``exp`` (1, T, 100) and
``jaw`` (1, T, 3); older files were written by hickle, which puts them into the group ``data`` and quotes their names.
ProbTalk3D (Wu et al. 2024) has one array (1, T, 403) with the three side by side.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.topology.flame_file import EXPRESSIONS, SHAPES

if TYPE_CHECKING:
    import h5py

WIDTHS = {"shape": SHAPES, "exp": EXPRESSIONS, "jaw": 3}
ALL = sum(WIDTHS.values())
MOST_FRAMES = 1_000_000
HDF5_SUFFIXES = (".hdf5", ".h5")

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Parameters:
    """Parameters of a clip of T frames.

    Attributes:
        shape: (S,) shape coefficients, their mean over the clip.
        expression: (T, E) expression coefficients.
        jaw: (T, 3) rotation of the jaw, axis-angle in radians.
    """

    shape: Array
    expression: Array
    jaw: Array


def read_parameters(path: Path) -> Parameters:
    """Read a clip's parameters: ``shape_pose_cam.hdf5`` of EMOTE (flat or by hickle), or ProbTalk3D's ``.npy``.

    The shape is averaged over all frames alike: which frames a face was well seen in is not in these files. Rotation
    of the head and the camera are left out.

    Raises:
        FaceDiffError: if the file is missing or damaged, lacks something, or holds NaN.
        MissingExtraError: if h5py is not installed and needed.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected FLAME parameters, .hdf5 or .npy")
    parts = _read_hdf5(path) if path.suffix.lower() in HDF5_SUFFIXES else _read_array(path)
    for name, values in parts.items():
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise FaceDiffError(
                f"{path}: frame {int(np.argmax(bad))} (counted from 0) of {name} holds NaN or infinity; leave the clip "
                f"out or get it anew"
            )
    frames = len(parts["exp"])
    if len(parts["jaw"]) != frames or len(parts["shape"]) not in (1, frames):
        counts = ", ".join(f"{len(values)} of {name}" for name, values in parts.items())
        raise FaceDiffError(f"{path}: its frames do not agree ({counts}); get it anew")
    return Parameters(parts["shape"].mean(axis=0), parts["exp"], parts["jaw"])


def _read_array(path: Path) -> dict[str, Array]:
    try:
        array = np.load(path, allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise FaceDiffError(f"{path}: not a readable NumPy array, perhaps truncated ({error}); get it anew") from error
    if not isinstance(array, np.ndarray) or array.dtype.kind != "f" or array.shape[-1:] != (ALL,):
        kind = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else "an archive"
        raise FaceDiffError(f"{path}: holds {kind}; expected floats of shape (1, frames, {ALL}), FLAME parameters")
    joined = _as_frames(array, ALL, f"{path}: the array")
    ends = np.cumsum(list(WIDTHS.values()))
    return dict(zip(WIDTHS, np.split(joined, ends[:-1], axis=1), strict=True))


def _read_hdf5(path: Path) -> dict[str, Array]:
    try:
        import h5py
    except ImportError as error:
        raise MissingExtraError("h5py", "prepare", "reading FLAME reconstructions (.hdf5)") from error
    try:
        with h5py.File(path, "r") as file:
            holder = file if "exp" in file else file.get("data", file)
            # hickle has the key with its quotes as a name.
            names = {name.strip("\"'"): name for name in holder} if isinstance(holder, h5py.Group) else {}
            absent = [name for name in WIDTHS if name not in names]
            if absent:
                raise FaceDiffError(
                    f"{path}: has no {', '.join(absent)} (it has {', '.join(sorted(names)) or 'nothing'}); expected "
                    f"shape, exp and jaw, as shape_pose_cam.hdf5 has them"
                )
            return {name: _dataset(holder, names[name], width, path) for name, width in WIDTHS.items()}
    except (OSError, KeyError, RuntimeError, ValueError) as error:
        raise FaceDiffError(f"{path}: not a readable HDF5 file, perhaps truncated ({error}); get it anew") from error


def _dataset(holder: h5py.Group, name: str, most: int, path: Path) -> Array:
    import h5py

    where = f"{path}: {name}"
    link, dataset = holder.get(name, getlink=True), holder.get(name)
    if not isinstance(dataset, h5py.Dataset) or dataset.dtype.kind not in "fiu":
        raise FaceDiffError(f"{where} holds no numbers; expected floats of shape (1, frames, up to {most})")
    # A file from elsewhere has no business to read other files of this machine.
    if isinstance(link, h5py.ExternalLink) or dataset.external or dataset.is_virtual:
        raise FaceDiffError(f"{where} lies in another file; expected a file that holds its own data")
    if max(dataset.shape, default=0) > MOST_FRAMES:
        raise FaceDiffError(f"{where} has shape {dataset.shape}; expected at most {MOST_FRAMES} frames")
    return _as_frames(dataset[()], most, where)


def _as_frames(values: npt.NDArray[np.generic], most: int, where: str) -> Array:
    """(T, D) from (1, T, D), the way in which these projects keep a batch of one."""
    exact = most in (WIDTHS["jaw"], ALL)  # of shape and expression, the last coefficients may be left out
    frames = values[0] if values.ndim == 3 and len(values) == 1 else values
    if frames.ndim != 2 or not len(frames) or not (most if exact else 1) <= frames.shape[1] <= most:
        raise FaceDiffError(
            f"{where} has shape {values.shape}; expected (1, frames, {'' if exact else 'up to '}{most}) with at least "
            f"one frame"
        )
    return frames.astype(np.float64)
