"""FLAME, the head model of Li et al., "Learning a model of facial shape and expression from 4D scans", 2017.

A layer in NumPy: the published Python packages are under non-commercial licences and unpickle the model file without
restriction. Users bring the files of the model and its masks. Equation numbers refer to SMPL (Loper et al. 2015), the
skinning that FLAME uses.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, check_known, damaged
from facediff.utils.arrays import read_arrays
from facediff.utils.numerics import Array, Floats, Indices
from facediff.utils.pickles import StandIn, load_pickle

SHAPES, EXPRESSIONS, JOINTS = 300, 100, 5
POSE_FEATURES = 9 * (JOINTS - 1)
JAW = 2  # Joints are in this order: root, neck, jaw, left eye, right eye
CHUNK = 32  # Frames that are computed at a time: their vertices stay in a processor's cache

Values = npt.NDArray[np.generic]


class Flame:
    """The model with its neck and eyes at rest; the jaw and, about the root joint, the head turn.

    Args:
        arrays: content of the model file.

    Attributes:
        template: (V, 3) the mean face, in metres.
        faces: (F, 3) vertex indices of the triangles.
    """

    def __init__(self, arrays: FlameArrays) -> None:
        self.template: Array = arrays.template
        self.faces = arrays.faces
        directions = arrays.directions.reshape(-1, SHAPES + EXPRESSIONS)
        self._shape_basis = directions[:, :SHAPES]
        nine = slice(9 * (JAW - 1), 9 * JAW)
        correctives = arrays.pose_directions.reshape(len(directions), -1)[:, nine]
        # Rows: expressions, then the nine pose correctives of the jaw; all frames are a combination of these rows.
        self._basis = np.ascontiguousarray(np.concatenate([directions[:, SHAPES:], correctives], axis=1).T)
        self._jaw_regressor, self._root_regressor = arrays.joint_regressor[JAW], arrays.joint_regressor[0]
        expressions = self._basis[:EXPRESSIONS].reshape(EXPRESSIONS, -1, 3)
        self._jaw_basis: Array = np.einsum("v,evc->ec", self._jaw_regressor, expressions)
        # Joints below the jaw turn with it and all others stay. The weights of a vertex add up to one, so that a single
        # weight for each vertex says how much it follows the jaw.
        moved = [JAW]
        for joint in range(JAW + 1, JOINTS):  # parents come before their children
            if arrays.parents[joint] in moved:
                moved.append(joint)
        weights = arrays.weights[:, moved].sum(axis=1)
        self._turning = np.flatnonzero(weights)
        self._weights = weights[self._turning, None]

    @classmethod
    def read(cls, path: Path) -> Flame:
        """Read a model file.

        FLAME 2019, 2020 or 2023 as distributed (``.pkl``), ``.npz`` with the same keys, or ARTalk's
        ``FLAME_with_eye.pt``.
        """
        return cls(read_flame_arrays(path))

    @property
    def n_vertices(self) -> int:
        """Vertices of the mesh."""
        return len(self.template)

    def shaped(self, shape: Floats) -> Array:
        """The face (V, 3) of shape coefficients (S,) at rest, eq. 8; S may be less than the model has, but not more."""
        coefficients = np.asarray(shape, np.float64)
        return np.asarray(self.template + (self._shape_basis[:, : len(coefficients)] @ coefficients).reshape(-1, 3))

    def vertices(self, shape: Floats, expression: Floats, jaw: Floats, *, head: Floats | None = None) -> Array:
        """Vertices (T, V, 3) in metres, without rotation of neck and eyes, eqs. 2 to 10.

        Joints are regressed from shape and expression together, as in the published implementations.

        Args:
            shape: (S,) shape coefficients, the same for all frames; omitted ones are zero.
            expression: (T, E) expression coefficients; omitted ones are zero.
            jaw: (T, 3) rotation of the jaw, axis-angle in radians.
            head: (T, 3) rotation of the whole about the root joint, likewise; None for none.
        """
        expression, jaw = np.asarray(expression, np.float64), np.asarray(jaw, np.float64)
        face, count = self.shaped(shape), expression.shape[1]
        result = np.empty((len(jaw), *face.shape))
        for first in range(0, len(jaw), CHUNK):
            part = slice(first, first + CHUNK)
            turns = rotations(jaw[part]) - np.eye(3)
            # The pose features of eq. 9 are the rotation without the identity, so that they are zero for a jaw at rest.
            posed = result[part]
            flat = posed.reshape(len(posed), -1)
            np.matmul(expression[part], self._basis[:EXPRESSIONS][:count], out=flat)
            # One product for a chunk of frames instead of one a frame; the basis has the jaw's rows only, since no
            # other joint turns.
            flat += turns.reshape(-1, 9) @ self._basis[EXPRESSIONS:]
            posed += face
            joint = (self._jaw_regressor @ face + expression[part] @ self._jaw_basis[:count])[:, None]
            # Eq. 2, (1 − w) x + w (R (x − j) + j), with the identity for every joint that stays.
            arms = posed[:, self._turning] - joint
            posed[:, self._turning] += self._weights * (arms @ turns.transpose(0, 2, 1))
            if head is not None:
                # All vertices hang from the root: its rotation turns the posed face about one point.
                root_basis = np.einsum("v,evc->ec", self._root_regressor, self._basis[:count].reshape(count, -1, 3))
                root = (self._root_regressor @ face + expression[part] @ root_basis)[:, None]
                posed[:] = (posed - root) @ rotations(head[part]).transpose(0, 2, 1) + root
        return result


def rotations(axis_angles: Floats) -> Array:
    """Rotation matrices (T, 3, 3) of axis-angle vectors (T, 3) in radians, by Rodrigues' formula, eq. 1.

    Example:
        >>> rotations(np.array([[0, 0, np.pi / 2]])).round(6)[0] @ [1, 0, 0]
        array([0., 1., 0.])
    """
    vectors = np.asarray(axis_angles, np.float64)
    angles = np.linalg.norm(vectors, axis=-1)[:, None, None]
    cross = np.zeros((len(vectors), 3, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        cross[:, row, column] = vectors[:, axis]
        cross[:, column, row] = -vectors[:, axis]
    # sin(a)/a and (1 − cos(a))/a², both without a division by zero.
    first, second = np.sinc(angles / np.pi), 0.5 * np.sinc(angles / (2 * np.pi)) ** 2
    return np.asarray(np.eye(3) + first * cross + second * (cross @ cross))


# Reading a FLAME model file without running anything that it asks for. The files of FLAME 2019 and 2020 are pickles of
# Python 2 that hold objects of chumpy and SciPy. Stand-ins keep the state of these objects, and the arrays are taken
# out of that state, so that neither class is ever created.

PACKAGES = ("chumpy", "scipy.sparse")
SPARSE = {f"{kind}_{name}" for kind in ("csc", "csr") for name in ("matrix", "array")}
DEEPEST = 16  # Objects within objects; a file could hold one that contains itself
MOST_VERTICES = 1_000_000
KEYS = ("v_template", "shapedirs", "posedirs", "J_regressor", "kintree_table", "weights", "f")
HELP = "expected generic_model.pkl of FLAME 2020, from flame.is.tue.mpg.de, as it is distributed"


@dataclass(frozen=True)
class FlameArrays:
    """Content of a model file as plain arrays; V vertices, F triangles."""

    template: Array  # (V, 3) mean face, in metres
    directions: Array  # (V, 3, 400) 300 directions of shape, then 100 of expression
    pose_directions: Array  # (V, 3, 36) correctives, nine for each joint but the root
    joint_regressor: Array  # (5, V) from vertices to joints
    parents: Indices  # (5,) parent of each joint; −1 for the root
    weights: Array  # (V, 5) skinning weights
    faces: npt.NDArray[np.int32]  # (F, 3) vertex indices


def read_flame_arrays(path: Path) -> FlameArrays:
    """Read a model file as :meth:`Flame.read` does."""
    with damaged(path, HELP):
        match path.suffix.lower():
            case ".npz":
                return _flame_arrays(read_arrays(path, KEYS, remedy=HELP), path)
            case ".pt":
                return _flame_arrays(read_tensors(path), path)
            case _:
                return _flame_arrays(load_pickle(path, stand_ins=PACKAGES), path)


def _flame_arrays(content: Any, path: Path) -> FlameArrays:  # noqa: ANN401 - of a file
    template = _numbers(content, "v_template", path, (None, 3))
    count = len(template)
    weights = _numbers(content, "weights", path, (count, JOINTS))
    faces = _numbers(content, "f", path, (None, 3))
    parents = _numbers(content, "kintree_table", path, (2, JOINTS))[0].astype(np.int64)
    parents[0] = -1  # the files have 2³² − 1 there
    # A parent comes before its children, so that one pass over the joints places all of them.
    ordered = (parents[1:] >= 0).all() and (parents < np.arange(JOINTS)).all()
    # Eq. 2 leaves the share 1 − w of a vertex where it is: right only where the weights of all joints sum to 1.
    complete = np.abs(weights.sum(axis=1) - 1).max() <= 1e-3
    if not (ordered and complete) or faces.min() < 0 or faces.max() >= count:
        raise FaceDiffError(
            f"{path}: f or kintree_table name vertices or joints that do not exist, or weights of a vertex do not sum "
            f"to 1; {HELP}"
        )
    return FlameArrays(
        template=template,
        directions=_numbers(content, "shapedirs", path, (count, 3, SHAPES + EXPRESSIONS)),
        pose_directions=_numbers(content, "posedirs", path, (count, 3, POSE_FEATURES)),
        joint_regressor=_numbers(content, "J_regressor", path, (JOINTS, count)),
        parents=parents,
        weights=weights,
        faces=faces.astype(np.int32),
    )


def read_tensors(path: Path) -> object:
    """The tensors of a PyTorch file as arrays; they may lie under ``flame_model``."""
    from facediff.utils.torch_files import load_tensors

    content = load_tensors(path, HELP)
    inner = content.get("flame_model", content) if isinstance(content, Mapping) else content
    if not isinstance(inner, Mapping):
        return inner
    return {name: value.numpy() for name, value in inner.items() if hasattr(value, "numpy")}


def _numbers(content: Mapping[Any, Any], key: str, path: Path, shape: tuple[int | None, ...]) -> Array:
    """An array of the file as float64, with its shape checked; None stands for any length but zero."""
    values = plain_array(content[key], f"{path}: {key}")
    as_expected = len(values.shape) == len(shape) and all(
        length == expected if expected is not None else length
        for length, expected in zip(values.shape, shape, strict=True)
    )
    numbers = values.astype(np.float64)
    if not as_expected or not np.isfinite(numbers).all():
        lengths = ", ".join("any" if length is None else str(length) for length in shape)
        raise FaceDiffError(f"{path}: {key} has shape {values.shape}, expected finite numbers ({lengths}); {HELP}")
    return numbers


def plain_array(value: object, where: str, depth: int = 0) -> Values:
    """The numbers of an array, of a sparse matrix or of a chumpy object that only stores or reorders them.

    chumpy pickles an object's attributes: ``Ch`` keeps its array as ``x``; ``Reshape``, ``transpose`` and ``Select``
    keep the array that they reorder as ``a``. Anything else, or too many objects in one another, is refused.
    """
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiu":
        return value
    if isinstance(value, StandIn) and depth < DEEPEST:
        package, _, name = value.origin.rpartition(".")
        state: Any = value.state
        with damaged(f"{where} ({value.origin})", "download the file again"):
            if package.startswith("scipy.") and name in SPARSE:
                return _dense(state, name[:3])
            if value.origin == "chumpy.ch.Ch":
                return plain_array(state["x"], where, depth + 1)
            if package == "chumpy.reordering" and name in ("Reshape", "transpose", "Select"):
                return _reordered(name, state, plain_array(state["a"], where, depth + 1))
    kind = getattr(value, "origin", None) or getattr(value, "dtype", None) or type(value).__name__
    raise FaceDiffError(f"{where} holds {kind}; expected numbers: convert the model to .npz with plain arrays")


def _reordered(name: str, state: Mapping[Any, Any], array: Values) -> Values:
    def numbers(key: str) -> tuple[int, ...] | None:
        return None if state.get(key) is None else tuple(int(i) for i in np.asarray(state[key]).ravel())

    if name == "Reshape":
        return array.reshape(numbers("newshape") or ())
    if name == "transpose":
        return array.transpose(numbers("axes"))
    selection = array.ravel()[np.asarray(state["idxs"], np.int64).ravel()]
    shape = numbers("preferred_shape")
    return selection if shape is None else selection.reshape(shape)


def _dense(state: Mapping[Any, Any], kind: str) -> Values:
    """A compressed-column or compressed-row matrix as (5, V) array."""
    # Not through scipy: it trusts the index arrays of a matrix, and these come from a file.
    rows, columns = (int(size) for size in np.asarray(state["_shape"]).ravel())
    data = np.asarray(state["data"], np.float64)
    ends, minor = np.asarray(state["indptr"], np.int64), np.asarray(state["indices"], np.int64)
    major = np.searchsorted(ends, np.arange(len(minor)), side="right") - 1  # of the data's size in any case
    row, column = (minor, major) if kind == "csc" else (major, minor)
    sound = (
        ends[-1] == len(minor)
        and rows == JOINTS
        and 0 < columns <= MOST_VERTICES
        and len(row) == len(column) == len(data)
    )
    if not sound or (len(data) and min(row.min(), column.min()) < 0):
        raise ValueError(f"is a matrix of ({rows}, {columns}); expected {JOINTS} rows, and indices that match its data")
    dense = np.zeros((rows, columns))
    np.add.at(dense, (row, column), data)
    return dense


def read_masks(path: Path, names: str) -> list[int]:
    """Vertex indices of one or several masks of a pickle such as ``FLAME_masks.pkl``.

    Args:
        path: a pickle that holds a dict from mask to indices, or a single list of indices.
        names: masks, several joined by "+" ("lips", "forehead+eye_region"), or without the vertices of others after "-"
            ("face-left_eyeball-right_eyeball"); the whole list if empty.
    """
    content = load_pickle(path)
    included, excluded = [], []
    with damaged(path, "expected a dict from masks to lists of vertex indices"):
        for part in names.split("+") if names else []:
            # A mask may have a hyphen in its own name.
            first, *rest = [part] if part in content else part.split("-")
            included.append(first)
            excluded += rest
        check_known(path, "mask", [*included, *excluded], [*map(str, content)])
        masks = [content[name] for name in [*included, *excluded]] if names else [content]
        arrays = [np.asarray(mask) for mask in masks]
        if any(array.ndim != 1 or not np.issubdtype(array.dtype, np.integer) for array in arrays):
            raise ValueError("holds other values than whole numbers")
    count = len(included) if names else 1
    without = {int(index) for array in arrays[count:] for index in array}
    return [int(index) for array in arrays[:count] for index in array if int(index) not in without]
