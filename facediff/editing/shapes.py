"""Sets of blendshapes: ARKit's names, a set that fits an animation, and the files that sets are read from."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from facediff.animation import metres_per_unit
from facediff.errors import FaceDiffError, OptionError, damaged
from facediff.mesh import face_size, robust_align
from facediff.spaces.arkit import absent_from, beyond_arkit
from facediff.spaces.shape_files import ShapeFiles, read_shape_files
from facediff.utils.numerics import Array, Floats

ANOTHER_ORDER = 0.3
"""Vertices of neutral faces further apart than this share of the face's size are not in the same order."""
ANOTHER_FACE, ENOUGH = 0.01, 8
"""Without a neutral face, so many shapes may have no more than this share of the face's size in common: each moves a
part of its own, so that their median is the face at rest that they were made from."""
SAME_SIZE = 1.25  # Heads differ by less than this factor; units of length differ by more
SAME_POSE = np.deg2rad(20.0)
STILL = 1e-6  # A shape that moves no vertex by more than this share of the face's size moves nothing


@dataclass(frozen=True, eq=False)
class ShapeSet:
    """Blendshapes of one face."""

    names: tuple[str, ...]  # K names; ARKit's own spelling where they are ARKit's
    neutral: Array  # (V, 3) the face at rest, in the animation's unit
    deltas: Array  # (K, V, 3) displacement of each vertex at weight 1
    notes: tuple[str, ...] = ()  # findings and changes on reading, a sentence each

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
        """The set without all other names; refused if it would be empty."""
        indices = [index for index, name in enumerate(self.names) if name in names]
        if not indices:
            raise FaceDiffError(
                f"shapes: {', '.join(self.names[:4])} … have no column in the table, as {names[0]} has; rename them or "
                f"write a plain table"
            )
        return replace(self, names=tuple(self.names[index] for index in indices), deltas=self.deltas[indices])


EXTRA_NOTE = "not ARKit's, kept as channels of their own"
"""Begin of the note on names that are not ARKit's."""

BUILT_IN = "puppet"
"""Name of the built-in face's shapes, in place of a folder or file."""


def is_built_in(path: Path) -> bool:
    """Whether a path stands for the shapes of the built-in face; a file or folder of that name goes first."""
    return str(path) == BUILT_IN and not path.exists()


def check_shapes(path: Path) -> None:
    """Refuse a path that is neither there nor stands for the built-in shapes."""
    if not path.exists() and not is_built_in(path):
        raise OptionError.naming(
            f"{{shapes}} {path}: no such folder or file; expected a folder of meshes, a .glb with targets, or puppet"
        )


def read_shapes(path: Path, template: Floats, unit: str = "m") -> ShapeSet:
    """Read a set of shapes for a face of the same topology.

    Args:
        path: a folder of ``.obj`` or ``.ply`` files named as their shapes are, the face at rest among them as
            ``neutral`` or ``Basis`` (without one, the template is the face at rest), a ``.glb`` with named targets, or
            ``puppet`` for the built-in shapes of the speaker with the nearest face.
        template: (V, 3) the animation's neutral face.
        unit: the template's unit of length.
    """
    metres = np.asarray(template, np.float64) * metres_per_unit(unit)
    return fitted(built_in_files(metres) if is_built_in(path) else read_shape_files(path, len(metres)), template, unit)


def fitted(files: ShapeFiles, template: Floats, unit: str = "m") -> ShapeSet:
    """Shapes as read, turned and scaled to a template by aligning their face at rest with it, if there is one."""
    if files.shapes.shape[1] != len(template):
        raise FaceDiffError(
            f"{files.first}: has {files.shapes.shape[1]} vertices and the animation's template {len(template)}; give "
            f"shapes of that mesh, or carry these over with `facediff blendshapes --carry`"
        )
    goal = np.asarray(template, np.float64)
    notes = list(files.notes)
    if files.neutral is not None:
        matrix = lay_onto(files, goal, notes, unit)
        return _named(files, goal, (files.shapes - files.neutral) @ matrix.T, notes)
    deltas = files.shapes / (metres_per_unit(unit) if files.metric else 1.0) - goal
    # A median that moves is the neutral face of these shapes: its difference from the template would be solved for in
    # every frame.
    common = np.median(deltas, axis=0) if len(deltas) >= ENOUGH else np.zeros_like(goal)
    size, least = face_size(goal), np.sqrt(np.square(deltas).sum(-1).mean(-1)).min()
    if np.sqrt(np.square(common).sum(-1).mean()) > ANOTHER_FACE * size or least > ANOTHER_ORDER * size:
        raise FaceDiffError(
            f"{files.path}: the shapes do not fit the animation's neutral face; add the face at rest that they were "
            f"made from as neutral{files.first.suffix}"
        )
    notes.append("no neutral face among the shapes: the animation's template is used instead")
    return _named(files, goal, deltas, notes)


def lay_onto(files: ShapeFiles, goal: Array, notes: list[str], unit: str) -> Array:
    """The (3, 3) rotation and scale from the files' face at rest to the template's; adds them to the notes."""
    neutral = np.asarray(files.neutral, np.float64)
    factor = 1.0 / metres_per_unit(unit) if files.metric else 1.0
    rest = files.first.parent / files.rest
    with damaged(rest, "give the face at rest of these shapes"):
        similarity = robust_align(neutral * factor, goal, scale=True)
    apart = np.linalg.norm(similarity.apply(neutral * factor) - goal, axis=1)
    if np.median(apart) > ANOTHER_ORDER * face_size(goal):
        raise OptionError.naming(
            f"{rest}: has the vertices of the animation's template in another order; write it again with the order "
            f"kept (Blender: import and export with vertex order), or use {{carry}}"
        )
    # A small difference in size or pose is another speaker's head; its displacements are used unchanged.
    scale = similarity.scale if not 1 / SAME_SIZE < similarity.scale < SAME_SIZE else 1.0
    angle = float(np.arccos(np.clip((np.trace(similarity.rotation) - 1) / 2, -1, 1)))
    if scale != 1.0:
        notes.append(f"the shapes are scaled by {scale:.4g} to the animation's unit of length")
    if angle > SAME_POSE:
        notes.append(f"the shapes are turned by {np.rad2deg(angle):.0f}° to the animation's axes")
    matrix: Array = scale * factor * (similarity.rotation if angle > SAME_POSE else np.eye(3))
    return matrix


def _named(files: ShapeFiles, neutral: Array, deltas: Array, notes: list[str]) -> ShapeSet:
    """The set under ARKit's names where there are such."""
    shape_set = ShapeSet(files.arkit_names, neutral, np.ascontiguousarray(deltas))
    if shape_set.extra:
        notes.append(f"{EXTRA_NOTE}: {', '.join(shape_set.extra)}")
    if shape_set.still:
        notes.append(f"move no vertex, so that their weights stay 0: {', '.join(shape_set.still)}")
    return replace(shape_set, notes=tuple(notes))


def built_in_files(template: Array | None = None) -> ShapeFiles:
    """The built-in shapes: of the speaker with the face nearest to a template (V, 3) in metres, or the common ones."""
    from facediff.synthetic.known_faces import built_in_shapes, is_built_in, resting_heads

    nearest = None
    if template is not None and is_built_in(len(template)):
        at_rest: dict[str | None, Array] = {None: built_in_shapes()[0]}
        at_rest.update(resting_heads().items())
        centred = template - template.mean(0)
        nearest = min(at_rest, key=lambda name: np.square(at_rest[name] - at_rest[name].mean(0) - centred).sum())
    neutral, faces, shapes = built_in_shapes(nearest)
    points = np.stack(list(shapes.values()))
    path = Path(BUILT_IN)
    return ShapeFiles(path, path, tuple(shapes), points, neutral, faces, metric=True, rest=BUILT_IN)
