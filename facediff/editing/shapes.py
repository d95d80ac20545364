"""Sets of blendshapes: ARKit's names, a set that fits an animation, and the files that sets are read from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import metres_per_unit
from facediff.editing.glb_shapes import read_targets
from facediff.errors import FaceDiffError, OptionError
from facediff.mesh import face_size, read_mesh, robust_align
from facediff.mesh.glb import open_glb

Array = npt.NDArray[np.float64]

# The 52 names are Apple's (developer documentation of ``ARFaceAnchor.BlendShapeLocation``). Their order and the further
# columns are those of the CSV files that Epic's app Live Link Face records, as public readers of such files state them.

_EYE = "eyeBlink{0} eyeLookDown{0} eyeLookIn{0} eyeLookOut{0} eyeLookUp{0} eyeSquint{0} eyeWide{0}"
_FACE = """
    jawForward jawRight jawLeft jawOpen mouthClose mouthFunnel mouthPucker mouthRight mouthLeft
    mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft mouthDimpleRight
    mouthStretchLeft mouthStretchRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper
    mouthPressLeft mouthPressRight mouthLowerDownLeft mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight
    browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight
    noseSneerLeft noseSneerRight tongueOut
"""
ARKIT: tuple[str, ...] = (*_EYE.format("Left").split(), *_EYE.format("Right").split(), *_FACE.split())
"""The names in the order of the recordings' columns."""

ROTATIONS: tuple[str, ...] = (
    *(f"Head{axis}" for axis in ("Yaw", "Pitch", "Roll")),
    *(f"{side}Eye{axis}" for side in ("Left", "Right") for axis in ("Yaw", "Pitch", "Roll")),
)
"""Columns that follow the names: rotations of the head and the eyes."""

NEUTRAL = ("neutral", "basis", "rest", "base", "template")
"""Names (without case and punctuation) of the face at rest in a set of shapes."""


def live_link_name(name: str) -> str:
    """An ARKit name as Live Link Face capitalises it: ``jawOpen`` becomes ``JawOpen``."""
    return name[:1].upper() + name[1:]


def mirror_pairs(names: tuple[str, ...] = ARKIT) -> list[tuple[int, int]]:
    """Places (left, right) of the names that differ in their side only, for those whose other side is there too."""
    place = {name: index for index, name in enumerate(names)}
    return [
        (index, place[other])
        for name, index in place.items()
        if name.endswith("Left") and (other := f"{name.removesuffix('Left')}Right") in place
    ]


def arkit_name(name: str) -> str | None:
    """The ARKit name that a spelling stands for: ``EyeBlink_L``, ``jaw_open``, ``17 - browInnerUp``; None if none."""
    # Leading digits number the shapes; what follows a dot, a colon or a bar is the shape's name within a node.
    spellings = _spellings()
    for part in (name, re.split(r"[.:|]", name)[-1]):
        key = plain(part)
        if arkit := spellings.get(key) or spellings.get(key.lstrip("0123456789")):
            return arkit
    return None


def plain(name: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


@lru_cache(maxsize=1)
def _spellings() -> dict[str, str]:
    spellings = {plain(name): name for name in ARKIT}
    for name in ARKIT:
        for side in ("Left", "Right"):
            if name.endswith(side):
                spellings[plain(name.removesuffix(side)) + side[0].lower()] = name
    return spellings


def absent_from(names: Sequence[str]) -> tuple[str, ...]:
    """Names of ARKit's that are not among ``names``, in ARKit's order."""
    return tuple(name for name in ARKIT if name not in names)


def beyond_arkit(names: Sequence[str]) -> tuple[str, ...]:
    """Those of ``names`` that are not ARKit's."""
    return tuple(name for name in names if name not in ARKIT)


ANOTHER_ORDER = 0.3
"""Neutral faces whose vertices lie further apart than this share of the face's size are not in the same order."""
ANOTHER_FACE, ENOUGH = 0.01, 8
"""Without a neutral face, so many shapes may have no more than this share of the face's size in common: each moves a
part of its own, so that their median is the face at rest that they were made from."""
SAME_SIZE = 1.25  # Heads differ by less than this factor; units of length differ by more
SAME_POSE = np.deg2rad(20.0)
STILL = 1e-6  # A shape that moves no vertex by more than this share of the face's size moves nothing


@dataclass(frozen=True, eq=False)
class ShapeSet:
    """Blendshapes of one face.

    Attributes:
        names: K names; ARKit's own spelling where they are ARKit's.
        neutral: (V, 3) the face at rest, in the animation's unit.
        deltas: (K, V, 3) displacement of each vertex at weight 1.
        notes: what was found and changed on reading, a sentence each.
    """

    names: tuple[str, ...]
    neutral: Array
    deltas: Array
    notes: tuple[str, ...] = ()

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
        """The set without all other names; refused if nothing would be left."""
        kept = [index for index, name in enumerate(self.names) if name in names]
        if not kept:
            raise FaceDiffError(f"shapes: none is named as one of {', '.join(names[:4])} …; name them so")
        return replace(self, names=tuple(self.names[index] for index in kept), deltas=self.deltas[kept])


BUILT_IN = "puppet"
"""What users give in place of a folder or file for the shapes of the built-in face."""


def is_built_in(path: Path) -> bool:
    """Whether a path stands for the shapes of the built-in face; a file or folder of that name goes first."""
    return str(path) == BUILT_IN and not path.exists()


def check_shapes(path: Path) -> None:
    """Refuse a path that is neither there nor stands for the built-in shapes."""
    if not path.exists() and not is_built_in(path):
        raise OptionError.naming(
            f"{{shapes}} {path}: no such folder or file; expected a folder of meshes, a .glb with targets, or puppet"
        )


def read_shapes(path: Path, template: npt.NDArray[np.floating], unit: str = "m") -> ShapeSet:
    """Read a set of shapes for a face of the same topology.

    Args:
        path: a folder of ``.obj`` or ``.ply`` files named as their shapes are, the face at rest among them as
            ``neutral`` or ``Basis`` (without one, the template is the face at rest), a ``.glb`` with named targets, or
            ``puppet`` for those of the built-in face, whose speaker with the nearest face they are taken from.
        template: (V, 3) the animation's neutral face.
        unit: the template's unit of length.
    """
    files = _built_in(np.asarray(template, np.float64) * metres_per_unit(unit)) if is_built_in(path) else None
    return fitted(files or read_shape_files(path, len(template)), template, unit)


def fitted(files: ShapeFiles, template: npt.NDArray[np.floating], unit: str = "m") -> ShapeSet:
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
    # A median that moves is another neutral face, which all shapes were made from: its difference from the template
    # would be solved for in every frame.
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
    """The (3, 3) rotation and scale from the files' face at rest to the template's; adds what it did to the notes."""
    neutral = np.asarray(files.neutral, np.float64)
    factor = 1.0 / metres_per_unit(unit) if files.metric else 1.0
    rest = files.first.parent / files.rest
    try:
        similarity = robust_align(neutral * factor, goal, scale=True)
    except FaceDiffError as error:
        raise FaceDiffError(f"{rest}: cannot be aligned with the animation's face: {error}") from error
    apart = np.linalg.norm(similarity.apply(neutral * factor) - goal, axis=1)
    if np.median(apart) > ANOTHER_ORDER * face_size(goal):
        raise OptionError.naming(
            f"{rest}: has the vertices of the animation's template in another order; write it again with the order "
            f"kept (Blender: import and export with vertex order), or use {{carry}}"
        )
    # A small difference in size or pose is another speaker's head, whose movements are used as they are.
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
    names: dict[str, str] = {}
    for name in files.names:
        own_name = arkit_name(name) or name
        if own_name in names:
            raise FaceDiffError(f'{files.path}: "{names[own_name]}" and "{name}" are both {own_name}; keep one of them')
        names[own_name] = name
    shape_set = ShapeSet(tuple(names), neutral, np.ascontiguousarray(deltas))
    if not np.isfinite(shape_set.deltas).all():
        raise FaceDiffError(f"{files.path}: a shape holds NaN or infinity; write it again")
    if shape_set.extra:
        notes.append(f"not ARKit's, kept as channels of their own: {', '.join(shape_set.extra)}")
    if shape_set.still:
        notes.append(f"move no vertex, so that their weights stay 0: {', '.join(shape_set.still)}")
    return replace(shape_set, notes=tuple(notes))


# Blendshapes on disk: a folder of meshes, or a .glb with named targets.

SUFFIXES = (".obj", ".ply")


@dataclass(frozen=True, eq=False)
class ShapeFiles:
    """Shapes as read, whatever their topology, unit and axes."""

    path: Path  # the folder or the file
    first: Path  # the file to name where the topology is wrong
    names: tuple[str, ...]  # K names as written
    shapes: npt.NDArray[np.floating]  # (K, V, 3) vertices of each shape
    neutral: npt.NDArray[np.floating] | None  # (V, 3) the face at rest; None if there is none
    faces: npt.NDArray[np.integer] | None  # (F, 3) triangles; None if there are none
    metric: bool = False  # whether lengths are in metres by definition of the format, as in .glb
    rest: str = ""  # name of the file with the face at rest
    notes: tuple[str, ...] = ()  # what was done to the shapes since, a sentence each


def read_shape_files(path: Path, vertices: int | None = None) -> ShapeFiles:
    """Read a folder of meshes or a .glb.

    Args:
        path: the folder or file.
        vertices: of the mesh that they are for, by which the parts of a .glb are chosen; None for all that have shapes.
    """
    if is_built_in(path):
        return _built_in(None)
    if path.suffix.lower() == ".glb":
        return _read_glb(path, vertices)
    if not path.is_dir():
        raise FaceDiffError(f"{path}: no such folder; expected one of .obj or .ply files, or a .glb with named targets")
    candidates = sorted(f for f in path.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    rest = [file for file in candidates if plain(file.stem) in NEUTRAL]
    if len(rest) > 1:
        raise FaceDiffError(f"{path}: {rest[0].name} and {rest[1].name} are both the face at rest; keep one of them")
    shapes = [file for file in candidates if file not in rest]
    if not shapes:
        raise FaceDiffError(f"{path}: holds no shapes; expected .obj or .ply files named jawOpen, mouthFunnel …")
    files = [*rest, *shapes]
    meshes = [read_mesh(file, points_allowed=True) for file in files]
    first = meshes[0]
    for file, mesh in zip(files, meshes, strict=True):
        if len(mesh.vertices) != len(first.vertices):
            raise FaceDiffError(
                f"{file}: has {len(mesh.vertices)} vertices and {files[0].name} {len(first.vertices)}; expected shapes "
                f"of one mesh"
            )
        if len(first.faces) and len(mesh.faces) and not np.array_equal(mesh.faces, first.faces):
            raise FaceDiffError(
                f"{file}: its triangles are not those of {files[0].name}; expected shapes of one mesh with the order "
                f"of its vertices kept"
            )
        if not np.isfinite(mesh.vertices).all():
            raise FaceDiffError(f"{file}: holds NaN or infinity; write it again")
    points, faces = np.stack([mesh.vertices for mesh in meshes]), meshes[0].faces
    return ShapeFiles(
        path,
        files[0],
        tuple(file.stem for file in shapes),
        points[len(rest) :],
        points[0] if rest else None,
        faces if len(faces) else None,
        rest=rest[0].name if rest else "",
    )


def _built_in(template: Array | None) -> ShapeFiles:
    """The built-in shapes: of the speaker with the face nearest to a template (V, 3) in metres, or the common ones."""
    from facediff.synthetic.known_faces import built_in_shapes, edition_of_mesh, resting_faces

    edition, nearest = None if template is None else edition_of_mesh(len(template)), None
    if template is not None and edition is not None:
        at_rest: dict[str | None, Array] = {None: built_in_shapes(None, edition)[0]}
        at_rest.update(resting_faces(edition).items())
        centred = template - template.mean(0)
        nearest = min(at_rest, key=lambda name: np.square(at_rest[name] - at_rest[name].mean(0) - centred).sum())
    neutral, faces, shapes = built_in_shapes(nearest, edition or 2)
    points = np.stack(list(shapes.values()))
    path = Path(BUILT_IN)
    return ShapeFiles(path, path, tuple(shapes), points, neutral, faces, metric=True, rest=BUILT_IN)


def _read_glb(path: Path, vertices: int | None) -> ShapeFiles:
    try:
        targets = read_targets(open_glb(path), vertices)
    except (ValueError, IndexError) as error:
        raise FaceDiffError(f"{path}: not a readable glb with shapes ({error}); export it again") from error
    points = targets.neutral + targets.deltas
    return ShapeFiles(path, path, targets.names, points, targets.neutral, targets.faces, metric=True, rest=path.name)
