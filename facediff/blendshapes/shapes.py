"""Sets of blendshapes: what each name does to a face."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.blendshapes.arkit import absent_from, arkit_name, beyond_arkit
from facediff.blendshapes.files import ShapeFiles, read_shape_files
from facediff.errors import FaceDiffError
from facediff.takes import metres_per_unit
from facediff.topology import face_size, robust_align

Array = npt.NDArray[np.float64]

ANOTHER_ORDER = 0.3
"""Neutral faces whose vertices lie further apart than this share of the face's size are not in the same order."""
ANOTHER_FACE, ENOUGH = 0.01, 8
"""Without a neutral face, so many shapes may have no more than this share of the face's size in common: each moves its
own part, so that their median is the face at rest that they were made from."""
SAME_SIZE = 1.25
"""People's heads differ less than this; units of length differ by more."""
SAME_POSE = np.deg2rad(20.0)
STILL = 1e-6
"""A shape that moves no vertex by more than this share of the face's size moves nothing."""


@dataclass(frozen=True, eq=False)
class ShapeSet:
    """Blendshapes of one face.

    Attributes:
        names: K names; ARKit's own spelling where they are ARKit's.
        neutral: (V, 3) the face at rest, in the take's unit.
        deltas: (K, V, 3) how each vertex moves at weight 1.
        notes: what was found and done on reading, a sentence each.
    """

    names: tuple[str, ...]
    neutral: Array
    deltas: Array
    notes: tuple[str, ...] = field(default=())

    @property
    def absent(self) -> tuple[str, ...]:
        """Names of ARKit's that are not in the set."""
        return absent_from(self.names)

    @property
    def extra(self) -> tuple[str, ...]:
        """Names that are not ARKit's."""
        return beyond_arkit(self.names)

    @property
    def still(self) -> tuple[str, ...]:
        """Names of shapes that move no vertex, such as a tongue's on a face without one."""
        least = STILL * face_size(self.neutral)
        return tuple(n for n, delta in zip(self.names, self.deltas, strict=True) if np.abs(delta).max() <= least)

    def only(self, names: Sequence[str]) -> ShapeSet:
        """The set without all other names.

        Raises:
            FaceDiffError: if nothing would be left.
        """
        kept = [index for index, name in enumerate(self.names) if name in names]
        if not kept:
            raise FaceDiffError(f"shapes: none is named as one of {', '.join(names[:4])} …; name them so")
        return replace(self, names=tuple(self.names[index] for index in kept), deltas=self.deltas[kept])


def read_shapes(path: Path, template: npt.NDArray[np.floating], unit: str = "m") -> ShapeSet:
    """Read a set of shapes for a face of the same topology.

    Args:
        path: a folder of ``.obj`` or ``.ply`` files named as their shapes are, the face at rest among them as
            ``neutral`` or ``Basis`` (without one, the template is the face at rest), or a ``.glb`` with named targets.
        template: (V, 3) the take's neutral face.
        unit: the template's unit of length.

    Raises:
        FaceDiffError: if a file is missing or damaged, has another topology or vertices in another order, or a name
            occurs twice.
    """
    return fitted(read_shape_files(path), template, unit)


def fitted(files: ShapeFiles, template: npt.NDArray[np.floating], unit: str = "m") -> ShapeSet:
    """Shapes as read, turned and scaled to a template of the same topology.

    Where the set has a face at rest, a unit or an axis of its own is told by laying that face onto the template.

    Raises:
        FaceDiffError: as :func:`read_shapes`.
    """
    if files.shapes.shape[1] != len(template):
        raise FaceDiffError(
            f"{files.first}: has {files.shapes.shape[1]} vertices and the take's template {len(template)}; give "
            f"shapes of that mesh, or carry these over with `facediff blendshapes --carry`"
        )
    goal = np.asarray(template, np.float64)
    size = face_size(goal)
    notes = list(files.notes)
    if files.neutral is None:
        deltas = files.shapes / metres_per_unit(unit) if files.metric else files.shapes.astype(np.float64)
        deltas = deltas - goal
        common = np.median(deltas, axis=0) if len(deltas) >= ENOUGH else np.zeros_like(goal)
        if np.sqrt(np.square(common).sum(-1).mean()) > ANOTHER_FACE * size or _least(deltas) > ANOTHER_ORDER * size:
            raise FaceDiffError(
                f"{files.path}: the shapes do not lie on the take's neutral face; add the face at rest that they were "
                f"made from as neutral{files.first.suffix}"
            )
        notes.append("no neutral face among the shapes: the take's template is taken for it")
        return _named(files, goal, deltas, notes)
    matrix = lay_onto(files, goal, notes, unit)
    return _named(files, goal, (files.shapes - files.neutral) @ matrix.T, notes)


def lay_onto(files: ShapeFiles, goal: Array, notes: list[str], unit: str) -> Array:
    """The (3, 3) turn and scale from the files' face at rest to the template's; says in the notes what it did."""
    neutral = np.asarray(files.neutral, np.float64)
    factor = 1.0 / metres_per_unit(unit) if files.metric else 1.0
    try:
        found = robust_align(neutral * factor, goal, scale=True)
    except FaceDiffError as error:
        raise FaceDiffError(
            f"{files.first.parent / files.rest}: cannot be laid onto the take's face: {error}"
        ) from error
    apart = np.linalg.norm(found.apply(neutral * factor) - goal, axis=1)
    if np.median(apart) > ANOTHER_ORDER * face_size(goal):
        raise FaceDiffError(
            f"{files.first.parent / files.rest}: its vertices are those of the take's template in another order; "
            f"write it anew with the order kept (Blender: import and export with vertex order), or use --carry"
        )
    scale = found.scale if not 1 / SAME_SIZE < found.scale < SAME_SIZE else 1.0
    angle = float(np.arccos(np.clip((np.trace(found.rotation) - 1) / 2, -1, 1)))
    if scale != 1.0:
        notes.append(f"the shapes are scaled by {scale:.4g} to the take's unit of length")
    if angle > SAME_POSE:
        notes.append(f"the shapes are turned by {np.rad2deg(angle):.0f}° to the take's axes")
    turned: Array = scale * factor * (found.rotation if angle > SAME_POSE else np.eye(3))
    return turned


def _least(deltas: Array) -> float:
    return float(np.sqrt(np.square(deltas).sum(-1).mean(-1)).min())


def _named(files: ShapeFiles, neutral: Array, deltas: Array, notes: list[str]) -> ShapeSet:
    """The set under ARKit's names where there are such."""
    names: dict[str, str] = {}
    for name in files.names:
        known = arkit_name(name) or name
        if known in names:
            raise FaceDiffError(f'{files.path}: "{names[known]}" and "{name}" are both {known}; keep one of them')
        names[known] = name
    made = ShapeSet(tuple(names), neutral, np.ascontiguousarray(deltas), tuple(notes))
    if made.extra:
        notes.append(f"not ARKit's, kept as channels of their own: {', '.join(made.extra)}")
    if made.still:
        notes.append(f"move no vertex, so that their weights stay 0: {', '.join(made.still)}")
    if not np.isfinite(made.deltas).all():
        raise FaceDiffError(f"{files.path}: a shape holds NaN or infinity; write it anew")
    return replace(made, notes=tuple(notes))
