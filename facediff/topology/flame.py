"""FLAME, the head model of Li et al., "Learning a model of facial shape and expression from 4D scans", 2017.

A layer of our own in NumPy: the published Python packages are under non-commercial licences and unpickle the model file
without restriction. The model itself is the user's own file, see :mod:`facediff.topology.flame_file`.

Equation numbers are those of SMPL (Loper et al. 2015), whose skinning FLAME uses.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.topology.flame_file import EXPRESSIONS, JOINTS, SHAPES, FlameArrays, read_flame_arrays

JAW = 2
"""Joints are in this order: root, neck, jaw, left eye, right eye."""
CHUNK = 32
"""Frames that are computed at a time: their vertices stay in a processor's cache."""

Array = npt.NDArray[np.float64]


def rotations(axis_angles: npt.NDArray[np.floating]) -> Array:
    """Rotation matrices (T, 3, 3) of axis-angle vectors (T, 3) in radians, by Rodrigues' formula, eq. 1."""
    vectors = np.asarray(axis_angles, np.float64)
    angles = np.linalg.norm(vectors, axis=-1)[:, None, None]
    cross = np.zeros((len(vectors), 3, 3))
    for row, column, axis in ((2, 1, 0), (0, 2, 1), (1, 0, 2)):
        cross[:, row, column] = vectors[:, axis]
        cross[:, column, row] = -vectors[:, axis]
    # sin(a)/a and (1 − cos(a))/a², both without a division by zero.
    first, second = np.sinc(angles / np.pi), 0.5 * np.sinc(angles / (2 * np.pi)) ** 2
    result: Array = np.eye(3) + first * cross + second * (cross @ cross)
    return result


class Flame:
    """The model with its head, neck and eyes at rest; only the jaw moves.

    Args:
        arrays: what the model file holds.

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
        # Rows: expressions, then the nine pose correctives of the jaw; what all frames are a combination of.
        self._basis = np.ascontiguousarray(np.concatenate([directions[:, SHAPES:], correctives], axis=1).T)
        self._jaw_regressor = arrays.joint_regressor[JAW]
        expressions = self._basis[:EXPRESSIONS].reshape(EXPRESSIONS, -1, 3)
        self._jaw_basis: Array = np.einsum("v,evc->ec", self._jaw_regressor, expressions)
        # What hangs on the jaw turns with it; all other joints stay, and the weights of a vertex add up to one.
        moved = [joint for joint in range(JOINTS) if JAW in _ancestors(arrays.parents, joint)]
        weights = arrays.weights[:, moved].sum(axis=1)
        self._turning = np.flatnonzero(weights)
        self._weights = weights[self._turning, None]

    @classmethod
    def read(cls, path: Path) -> Flame:
        """Read a model file: FLAME 2019, 2020 or 2023 as distributed (``.pkl``), or ``.npz`` with the same keys.

        Raises:
            FaceDiffError: if the file is missing, is no FLAME model, or asks for code to be run; it is not run.
        """
        return cls(read_flame_arrays(path))

    @property
    def n_vertices(self) -> int:
        """Vertices of the mesh."""
        return len(self.template)

    def shaped(self, shape: npt.NDArray[np.floating]) -> Array:
        """The face (V, 3) of shape coefficients (S,) at rest, eq. 8; S may be less than the model has.

        Raises:
            FaceDiffError: if there are too many coefficients.
        """
        given = _coefficients("shape", shape, SHAPES, 1)
        face: Array = self.template + (self._shape_basis[:, : len(given)] @ given).reshape(-1, 3)
        return face

    def vertices(
        self,
        shape: npt.NDArray[np.floating],
        expression: npt.NDArray[np.floating],
        jaw: npt.NDArray[np.floating],
    ) -> Array:
        """Vertices (T, V, 3) in metres, without rotation of head, neck and eyes, eqs. 2 to 10.

        Joints are regressed from shape and expression together, as the published implementations do it.

        Args:
            shape: (S,) shape coefficients, the same for all frames; those left out are zero.
            expression: (T, E) expression coefficients; those left out are zero.
            jaw: (T, 3) rotation of the jaw, axis-angle in radians.

        Raises:
            FaceDiffError: if there are too many coefficients, or the frames do not agree.
        """
        expression = _coefficients("expression", expression, EXPRESSIONS, 2)
        jaw = _coefficients("jaw", jaw, 3, 2)
        if len(jaw) != len(expression) or jaw.shape[1] != 3:
            raise FaceDiffError(
                f"jaw has shape {jaw.shape} and expression {expression.shape}; expected (frames, 3) and (frames, E)"
            )
        face = self.shaped(shape)
        result = np.empty((len(jaw), *face.shape))
        for first in range(0, len(jaw), CHUNK):
            part = slice(first, first + CHUNK)
            self._pose(face, expression[part], jaw[part], result[part])
        return result

    def _pose(self, face: Array, expression: Array, jaw: Array, result: Array) -> None:
        turns = rotations(jaw) - np.eye(3)
        count = expression.shape[1]
        flat = result.reshape(len(result), -1)
        np.matmul(expression, self._basis[:count], out=flat)
        flat += turns.reshape(-1, 9) @ self._basis[EXPRESSIONS:]
        result += face
        joint = (self._jaw_regressor @ face + expression @ self._jaw_basis[:count])[:, None]
        # Eq. 2, (1 − w) x + w (R (x − j) + j), with the identity for every joint that stays.
        arms = result[:, self._turning] - joint
        result[:, self._turning] += self._weights * (arms @ turns.transpose(0, 2, 1))


def _ancestors(parents: npt.NDArray[np.int64], joint: int) -> list[int]:
    """A joint, its parent, the parent of that … up to the root, whose parent is −1."""
    chain = []
    while joint >= 0:
        chain.append(joint)
        joint = int(parents[joint])
    return chain


def _coefficients(name: str, values: npt.NDArray[np.floating], most: int, dimensions: int) -> Array:
    array = np.asarray(values, np.float64)
    if array.ndim != dimensions or array.shape[-1] > most:
        expected = f"(up to {most},)" if dimensions == 1 else f"(frames, up to {most})"
        raise FaceDiffError(f"{name} coefficients have shape {array.shape}; expected {expected}, as FLAME has {most}")
    return array
