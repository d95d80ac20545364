"""Reading a FLAME model file without running anything that it asks for.

The files of FLAME 2019 and 2020 are pickles of Python 2 that hold objects of chumpy and SciPy. Neither package is
needed here: stand-ins keep the objects' state, and the arrays are taken out of it.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.pickles import StandIn, load_pickle

SHAPES, EXPRESSIONS, JOINTS = 300, 100, 5
POSE_FEATURES = 9 * (JOINTS - 1)
PACKAGES = ("chumpy", "scipy.sparse")
SPARSE = {f"{kind}_{name}" for kind in ("csc", "csr", "coo") for name in ("matrix", "array")}
DEEPEST = 16
"""Objects within objects; a file could hold one that contains itself."""
MOST_VERTICES = 1_000_000
KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "f")
HELP = "expected generic_model.pkl of FLAME 2020, from flame.is.tue.mpg.de, as it is distributed"

Values = npt.NDArray[np.generic]


@dataclass(frozen=True)
class FlameArrays:
    """What a model file holds, as plain arrays; V vertices, F triangles.

    Attributes:
        template: (V, 3) mean face, in metres.
        directions: (V, 3, 400) 300 directions of shape, then 100 of expression.
        pose_directions: (V, 3, 36) correctives, nine for each joint but the root.
        joint_regressor: (5, V) from vertices to joints.
        parents: (5,) parent of each joint; −1 for the root.
        weights: (V, 5) skinning weights.
        faces: (F, 3) vertex indices.
    """

    template: npt.NDArray[np.float64]
    directions: npt.NDArray[np.float64]
    pose_directions: npt.NDArray[np.float64]
    joint_regressor: npt.NDArray[np.float64]
    parents: npt.NDArray[np.int64]
    weights: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int32]


def read_flame_arrays(path: Path) -> FlameArrays:
    """Read a model file, ``.pkl`` or ``.npz``.

    Raises:
        FaceDiffError: if the file is missing, is no FLAME model, or asks for code to be run; it is not run.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; {HELP}")
    content = _read_npz(path) if path.suffix.lower() == ".npz" else load_pickle(path, stand_ins=PACKAGES)
    if not isinstance(content, Mapping):
        raise FaceDiffError(f"{path}: holds a {type(content).__name__}, no FLAME model; {HELP}")
    absent = [key for key in KEYS if key not in content]
    if absent:
        raise FaceDiffError(f"{path}: has no {', '.join(absent)}, so it is no FLAME model; {HELP}")
    template = _numbers(content, "v_template", path, (None, 3))
    count = len(template)
    weights = _numbers(content, "weights", path, (count, JOINTS))
    if np.abs(weights.sum(axis=1) - 1).max() > 1e-3:
        raise FaceDiffError(f"{path}: the weights of a vertex do not add up to 1; {HELP}")
    faces = _numbers(content, "f", path, (None, 3))
    if faces.min() < 0 or faces.max() >= count:
        raise FaceDiffError(f"{path}: f names vertices that are not there; {HELP}")
    return FlameArrays(
        template=template,
        directions=_numbers(content, "shapedirs", path, (count, 3, SHAPES + EXPRESSIONS)),
        pose_directions=_numbers(content, "posedirs", path, (count, 3, POSE_FEATURES)),
        joint_regressor=_numbers(content, "J_regressor", path, (JOINTS, count)),
        parents=_parents(content, path),
        weights=weights,
        faces=faces.astype(np.int32),
    )


def _read_npz(path: Path) -> dict[str, Values]:
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {key: archive[key] for key in KEYS if key in archive}
    except (OSError, ValueError, EOFError, TypeError, zipfile.BadZipFile) as error:
        raise FaceDiffError(f"{path}: not a readable .npz of plain arrays ({error}); {HELP}") from error


def _numbers(
    content: Mapping[Any, Any], key: str, path: Path, shape: tuple[int | None, ...]
) -> npt.NDArray[np.float64]:
    """An array of the file as float64, with its shape checked; None stands for any length but zero."""
    values = plain_array(content[key], f"{path}: {key}")
    fits = len(values.shape) == len(shape) and all(
        got == wanted if wanted is not None else got for got, wanted in zip(values.shape, shape, strict=True)
    )
    if not fits:
        words = ", ".join("any" if length is None else str(length) for length in shape)
        raise FaceDiffError(f"{path}: {key} has shape {values.shape}, expected ({words}); {HELP}")
    numbers = values.astype(np.float64)
    if not np.isfinite(numbers).all():
        raise FaceDiffError(f"{path}: {key} holds NaN or infinity; get the file anew")
    return numbers


def _parents(content: Mapping[Any, Any], path: Path) -> npt.NDArray[np.int64]:
    table = _numbers(content, "kintree_table", path, (2, JOINTS))
    parents = table[0].astype(np.int64)
    parents[0] = -1  # the files have 2³² − 1 there
    if (parents[1:] < 0).any() or (parents >= np.arange(JOINTS)).any():
        raise FaceDiffError(f"{path}: kintree_table has the parents {parents.tolist()}; {HELP}")
    return parents


def plain_array(value: object, where: str, depth: int = 0) -> Values:
    """The numbers of an array, of a sparse matrix or of a chumpy object that only stores or reorders them.

    chumpy pickles an object's attributes: ``Ch`` keeps its array as ``x``; ``Reshape``, ``transpose`` and ``Select``
    keep what they reorder as ``a``.

    Args:
        value: an array or a stand-in.
        where: names the value in messages.
        depth: how many objects it lies in.

    Raises:
        FaceDiffError: if the value is anything else.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        return value
    if not isinstance(value, StandIn):
        kind = value.dtype if isinstance(value, np.ndarray) else type(value).__name__
        raise FaceDiffError(f"{where} holds {kind}, expected an array of numbers; {HELP}")
    package, _, name = value.origin.rpartition(".")
    state = value.state if isinstance(value.state, Mapping) else {}
    try:
        if package.startswith("scipy.") and name in SPARSE:
            return _dense(state, name[:3], where)
        if value.origin == "chumpy.ch.Ch" and depth < DEEPEST:
            return plain_array(state["x"], where, depth + 1)
        if package == "chumpy.reordering" and depth < DEEPEST:
            return _reordered(name, state, plain_array(state["a"], where, depth + 1))
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise FaceDiffError(f"{where} is a damaged {value.origin} ({error!r}); get the file anew") from error
    raise FaceDiffError(
        f"{where} is a {value.origin}, which is not understood; convert the model to .npz with plain arrays, "
        f"under the same keys"
    )


def _reordered(name: str, state: Mapping[Any, Any], array: Values) -> Values:
    def whole(key: str) -> tuple[int, ...] | None:
        return None if state.get(key) is None else tuple(int(i) for i in np.asarray(state[key]).ravel())

    if name == "Reshape":
        return array.reshape(whole("newshape") or ())
    if name == "transpose":
        return array.transpose(whole("axes"))
    if name == "Select":
        chosen = array.ravel()[np.asarray(state["idxs"], np.int64).ravel()]
        shape = whole("preferred_shape")
        return chosen if shape is None else chosen.reshape(shape)
    raise ValueError(f"{name} is not understood")


def _dense(state: Mapping[Any, Any], kind: str, where: str) -> Values:
    """A compressed-column, compressed-row or coordinate matrix as (5, V) array."""
    rows, columns = (int(size) for size in np.asarray(state["_shape"]).ravel())
    if rows != JOINTS or not 0 < columns <= MOST_VERTICES:
        raise FaceDiffError(f"{where} has shape ({rows}, {columns}), expected {JOINTS} rows; {HELP}")
    data = np.asarray(state["data"], np.float64)
    if kind == "coo":
        places = state["coords"] if "coords" in state else (state["row"], state["col"])
        row, column = (np.asarray(place, np.int64) for place in places)
    else:
        ends = np.asarray(state["indptr"], np.int64)
        minor = np.asarray(state["indices"], np.int64)
        major = np.repeat(np.arange(len(ends) - 1), np.diff(ends))
        row, column = (minor, major) if kind == "csc" else (major, minor)
    if len(data) and min(row.min(), column.min()) < 0:
        raise ValueError("negative index")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (row, column), data)
    return dense
