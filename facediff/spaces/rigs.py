"""Rigs: the displacements of the channels of a space, and vertices from values through them."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError
from facediff.mesh.flame import EXPRESSIONS, Flame
from facediff.spaces.arkit import ARKIT, absent_from, plain
from facediff.spaces.rotations import convert
from facediff.spaces.shape_files import ICT_NEUTRAL, read_shape_files
from facediff.spaces.space import Space
from facediff.utils.numerics import Array, Floats, Integers

Values = Floats


@dataclass(frozen=True, eq=False)
class LinearRig:
    """A linear face model: a neutral face plus a weighted sum of displacements.

    Example:
        >>> rig = LinearRig(("jawOpen",), np.zeros((2, 3)), np.ones((1, 2, 3)))
        >>> rig.decode(np.array([[0.5]]))[0, 0], rig.gram()
        (array([0.5, 0.5, 0.5]), array([[6.]]))
    """

    names: tuple[str, ...]  # C channels; ARKit's own spelling where they are ARKit's
    neutral: Array  # (V, 3) the face at rest
    deltas: Array  # (C, V, 3) displacements of the vertices at weight 1
    faces: Integers | None = None  # (F, 3) triangles
    unit: str = "m"  # of length; empty if the file does not say
    title: str = ""  # in messages and records

    @classmethod
    def read(cls, path: Path) -> LinearRig:
        """Read the morph targets of a ``.glb``, or a folder of meshes such as ICT-FaceKit's ``FaceXModel``."""
        files = read_shape_files(path)
        if files.neutral is None:
            raise FaceDiffError(f"{files.path}: has no face at rest; add it as neutral{files.first.suffix}")
        neutral = np.asarray(files.neutral, np.float64)
        centimetres = plain(Path(files.rest).stem) == ICT_NEUTRAL
        unit = "m" if files.metric else "cm" if centimetres else ""
        return cls(files.arkit_names, neutral, files.shapes - neutral, files.faces, unit, files.path.name)

    @cached_property
    def hash(self) -> str:
        """SHA-256 of the names and displacements, which identifies the rig of coefficients."""
        digest = hashlib.sha256("\0".join(self.names).encode())
        digest.update(np.ascontiguousarray(self.deltas, "<f4").tobytes())
        return digest.hexdigest()

    @property
    def space(self) -> Space:
        """The space of the rig's weights."""
        space = Space("linear", self.names, rig=self.title, rig_hash=self.hash)
        if not set(self.names) <= set(ARKIT):
            return space
        return replace(space, kind="arkit", version="arkit", valid_range=(0.0, 1.0), absent=absent_from(self.names))

    def only(self, names: Sequence[str]) -> LinearRig:
        """The rig's channels of these names, in their order."""
        column = {name.casefold(): index for index, name in enumerate(self.names)}
        lacking = [name for name in names if name.casefold() not in column]
        if lacking:
            raise FaceDiffError(f"{self.title or 'rig'}: has no {', '.join(lacking[:4])}; give a rig with these shapes")
        deltas = self.deltas[[column[name.casefold()] for name in names]]
        return LinearRig(tuple(names), self.neutral, deltas, self.faces, self.unit, self.title)

    def decode(self, values: Values, neutral: Values | None = None) -> Array:
        """Vertices (T, V, 3) of values (T, C).

        Args:
            values: in the order of the rig's names.
            neutral: (V, 3) another face at rest; the rig's own if None.
        """
        moved = np.asarray(values, np.float64) @ self.deltas.reshape(len(self.names), -1)
        return moved.reshape(len(values), *self.neutral.shape) + (self.neutral if neutral is None else neutral)

    def gram(self, weights: Values | None = None) -> Array:
        """G = D Dᵀ (C, C): x G xᵀ is the sum of the squared displacements of all vertices that weights x make.

        So a loss on weights is the loss on vertices, without building any.

        Args:
            weights: (V,) of the vertices; all 1 if None.
        """
        flat = self.deltas.reshape(len(self.names), -1)
        scaled = flat if weights is None else flat * np.repeat(np.asarray(weights, np.float64), 3)
        return np.asarray(scaled @ flat.T)


def flame_rig(flame: Flame, *, jaw: bool = False) -> LinearRig:
    """FLAME's expressions as a linear rig.

    Args:
        flame: the model.
        jaw: add the jaw's rotation by its tangent at rest (``jaw_x``, ``jaw_y``, ``jaw_z``, in radians), which is 2 %
            short at 0.35 radians; :func:`decode_flame` turns it exactly.
    """
    count = flame.n_vertices
    still = np.zeros((EXPRESSIONS, 3))
    deltas = flame.vertices(np.zeros(0), np.eye(EXPRESSIONS), still) - flame.template
    names = tuple(f"expression_{index}" for index in range(EXPRESSIONS))
    if jaw:
        turns = 1e-3 * np.concatenate([np.eye(3), -np.eye(3)])
        ends = flame.vertices(np.zeros(0), np.zeros((6, 1)), turns)
        deltas = np.concatenate([deltas, (ends[:3] - ends[3:]) / 2e-3])
        names += ("jaw_x", "jaw_y", "jaw_z")
    return LinearRig(names, flame.template, deltas.reshape(len(names), count, 3), flame.faces, "m", "FLAME")


def decode_flame(flame: Flame, values: Values, space: Space, shape: Values | None = None) -> Array:
    """Vertices (T, V, 3) in metres of FLAME coefficients.

    Expressions, jaw and head act, as the space writes them; the neck and the eyeballs stay at rest, and channels that
    FLAME has no displacement for, such as a translation, do nothing.

    Args:
        flame: the model.
        values: (T, C).
        space: their space, of the kind ``flame``.
        shape: (S,) the person's coefficients; the mean face if None.
    """
    if space.kind != "flame":
        raise FaceDiffError(f"motion: is in a space of {space.kind}; expected FLAME's coefficients")
    expression = np.zeros((len(values), EXPRESSIONS))
    for column, name in enumerate(space.channels):
        family, _, index = name.rpartition("_")
        if family == "expression" and index.isdecimal() and int(index) < EXPRESSIONS:
            expression[:, int(index)] = values[:, column]
    turns = {"jaw": np.zeros((len(values), 3)), "head": np.zeros((len(values), 3))}
    for turn in space.rotations:
        if turn.joint in turns:
            turns[turn.joint] = convert(values[:, list(turn.channels)], turn.form, "axis_angle")
    return flame.vertices(np.zeros(0) if shape is None else shape, expression, turns["jaw"], head=turns["head"])
