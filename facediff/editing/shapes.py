"""Sets of blendshapes: what each name does to a face."""

from __future__ import annotations

import json
import re
import struct
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import metres_per_unit
from facediff.errors import FaceDiffError
from facediff.mesh import face_size, read_mesh, robust_align
from facediff.mesh.mesh import read_obj

# The 52 names of ARKit's face and how others spell them.
#
# Names are Apple's (developer documentation of ``ARFaceAnchor.BlendShapeLocation``). Their order and the columns beside
# them are those of the CSV files that Epic's app Live Link Face records, as public readers of such files state them.

_EYE = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide")
ARKIT: tuple[str, ...] = (
    *(f"{name}Left" for name in _EYE),
    *(f"{name}Right" for name in _EYE),
    "jawForward",
    "jawRight",
    "jawLeft",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthRight",
    "mouthLeft",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
)
"""The names in the order of the recordings' columns."""

ROTATIONS: tuple[str, ...] = (
    *(f"Head{axis}" for axis in ("Yaw", "Pitch", "Roll")),
    *(f"{side}Eye{axis}" for side in ("Left", "Right") for axis in ("Yaw", "Pitch", "Roll")),
)
"""Columns that follow the names: turns of the head and the eyes."""

NEUTRAL = ("neutral", "basis", "rest", "base", "template")
"""Names (without case and punctuation) of the face at rest in a set of shapes."""


def live_link_name(name: str) -> str:
    """An ARKit name as the recordings capitalise it: ``jawOpen`` is ``JawOpen``."""
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
    known = _spellings()
    for part in (name, re.split(r"[.:|]", name)[-1]):
        key = plain(part)
        if found := known.get(key) or known.get(key.lstrip("0123456789")):
            return found
    return None


def plain(name: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


@lru_cache(maxsize=1)
def _spellings() -> dict[str, str]:
    known = {plain(name): name for name in ARKIT}
    for name in ARKIT:
        for side in ("Left", "Right"):
            if name.endswith(side):
                known[plain(name.removesuffix(side)) + side[0].lower()] = name
    return known


def absent_from(names: Sequence[str]) -> tuple[str, ...]:
    """Names of ARKit's that are not among ``names``, in ARKit's order."""
    return tuple(name for name in ARKIT if name not in names)


def beyond_arkit(names: Sequence[str]) -> tuple[str, ...]:
    """Those of ``names`` that are not ARKit's."""
    return tuple(name for name in names if name not in ARKIT)


# Blendshapes on disk: a folder of meshes, or a glb with named targets.

SUFFIXES = (".obj", ".ply")


@dataclass(frozen=True, eq=False)
class ShapeFiles:
    """Shapes as read, whatever their topology, unit and axes.

    Attributes:
        path: the folder or the file.
        first: the file to name where the topology is wrong.
        names: K names as written.
        shapes: (K, V, 3) vertices of each shape.
        neutral: (V, 3) the face at rest; None if there is none.
        faces: (F, 3) triangles; None if there are none.
        metric: whether lengths are in metres by prescription, as in glb.
        rest: name of the file with the face at rest.
        notes: what was found on reading.
    """

    path: Path
    first: Path
    names: tuple[str, ...]
    shapes: npt.NDArray[np.floating]
    neutral: npt.NDArray[np.floating] | None
    faces: npt.NDArray[np.integer] | None
    metric: bool = False
    rest: str = ""
    notes: tuple[str, ...] = field(default=())


def read_shape_files(path: Path) -> ShapeFiles:
    """Read a folder of meshes or a glb.

    Raises:
        FaceDiffError: if it is missing or damaged, holds no shapes, or its meshes differ in topology or vertex order.
    """
    if path.suffix.lower() == ".glb":
        mesh = read_glb_targets(path)
        return ShapeFiles(
            path, path, mesh.names, mesh.neutral + mesh.deltas, mesh.neutral, mesh.faces, metric=True, rest=path.name
        )
    if not path.is_dir():
        raise FaceDiffError(f"{path}: no such folder; expected one of .obj or .ply files, or a .glb with named targets")
    found = sorted(f for f in path.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    rest = [file for file in found if plain(file.stem) in NEUTRAL]
    if len(rest) > 1:
        raise FaceDiffError(f"{path}: {rest[0].name} and {rest[1].name} are both the face at rest; keep one of them")
    shapes = [file for file in found if file not in rest]
    if not shapes:
        raise FaceDiffError(f"{path}: holds no shapes; expected .obj or .ply files named jawOpen, mouthFunnel …")
    meshes = _read_alike([*rest, *shapes])
    points = np.stack([vertices for vertices, _ in meshes])
    return ShapeFiles(
        path,
        (rest or shapes)[0],
        tuple(file.stem for file in shapes),
        points[len(rest) :],
        points[0] if rest else None,
        meshes[0][1],
        rest=rest[0].name if rest else "",
    )


def _read_alike(files: list[Path]) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.integer] | None]]:
    """Vertices and triangles of each file; all must have the first one's topology."""
    meshes: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.integer] | None]] = []
    text = None
    for file in files:
        if file.suffix.lower() == ".obj":
            obj = read_obj(file)
            # Equal lines are equal triangles, and reading them takes longest.
            same = text is not None and obj.face_text == text
            meshes.append((obj.vertices, meshes[0][1] if same else obj.faces))
            text = obj.face_text if len(meshes) == 1 else text
        else:
            mesh = read_mesh(file)
            meshes.append((mesh.vertices, mesh.faces))
        (first, faces), (vertices, triangles) = meshes[0], meshes[-1]
        if len(vertices) != len(first):
            raise FaceDiffError(
                f"{file}: has {len(vertices)} vertices and {files[0].name} {len(first)}; expected shapes of one mesh"
            )
        if faces is not None and triangles is not None and not np.array_equal(faces, triangles):
            raise FaceDiffError(
                f"{file}: its triangles are not those of {files[0].name}; expected shapes of one mesh with the order "
                f"of its vertices kept"
            )
        if not np.isfinite(vertices).all():
            raise FaceDiffError(f"{file}: holds NaN or infinity; write it anew")
    return meshes


# Morph targets of binary glTF 2.0 files, which may come from anywhere: every offset and count is checked.
#
# Khronos Group, "glTF 2.0 Specification": sections 3.6 (binary data, accessors, sparse accessors), 3.7.2 (meshes, morph
# targets) and 4.4 (GLB). Names of targets are in ``mesh.extras.targetNames``, as the specification's note has it.

Array = npt.NDArray[np.float64]

MAGIC, JSON_CHUNK, BIN_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
FLOAT = 5126
INDICES: dict[int, np.dtype[Any]] = {5121: np.dtype("u1"), 5123: np.dtype("<u2"), 5125: np.dtype("<u4")}
WIDTHS = {"SCALAR": 1, "VEC3": 3}
TRIANGLES = 4


@dataclass(frozen=True, eq=False)
class GlbTargets:
    """A mesh with named targets.

    Attributes:
        names: K names.
        neutral: (V, 3) vertices, the primitives' one after the other; in metres.
        deltas: (K, V, 3) displacements.
        faces: (F, 3) triangles.
    """

    names: tuple[str, ...]
    neutral: Array
    deltas: Array
    faces: npt.NDArray[np.int64]


def read_glb_targets(path: Path) -> GlbTargets:
    """Read the mesh with the most targets; nodes' transforms are not applied.

    Raises:
        FaceDiffError: if the file is missing, damaged or compressed, or no mesh in it has named targets.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected a .glb file") from error
    try:
        return _mesh(_Glb(data))
    except _BadFileError as error:
        raise FaceDiffError(f"{path}: {error}") from error
    except (LookupError, TypeError, ValueError, AttributeError, struct.error, RecursionError) as error:
        raise FaceDiffError(f"{path}: not a readable glb ({error}); export it anew") from error


class _BadFileError(Exception):
    """What is wrong with a file, without its name."""


class _Glb:
    """The file's JSON, and accessors by number.

    Attributes:
        gltf: the JSON.
        binary: the bytes beside it.
    """

    def __init__(self, data: bytes) -> None:
        if len(data) < 20 or struct.unpack_from("<II", data)[0:2] != (MAGIC, 2):
            raise _BadFileError("not a binary glTF 2.0 file; export it as .glb")
        chunks: dict[int, bytes] = {}
        place, end = 12, min(len(data), struct.unpack_from("<I", data, 8)[0])
        while place + 8 <= end:
            length, kind = struct.unpack_from("<II", data, place)
            if place + 8 + length > end:
                raise _BadFileError("ends in the middle; export it anew")
            chunks.setdefault(kind, data[place + 8 : place + 8 + length])
            place += 8 + length
        self.gltf: dict[str, Any] = json.loads(chunks[JSON_CHUNK])
        self.binary = chunks.get(BIN_CHUNK, b"")
        needed = [name for name in self.gltf.get("extensionsRequired", []) if "compression" in name or "quant" in name]
        if needed:
            raise _BadFileError(f"is compressed ({', '.join(map(str, needed))}); export it without compression")

    def get(self, kind: str, index: object) -> dict[str, Any]:
        """An object by its number; numbers from the end, which Python would take, are refused."""
        listed = self.gltf[kind]
        if not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < len(listed):
            raise _BadFileError(f"names {kind} {index}, which is not there; export it anew")
        found: dict[str, Any] = listed[index]
        return found

    def slab(self, view: object, offset: int, kind: np.dtype[Any], count: int, width: int) -> npt.NDArray[Any]:
        """Numbers (count, width) from a buffer view."""
        found = self.get("bufferViews", view)
        if found.get("buffer", 0) != 0 or "uri" in self.get("buffers", 0):
            raise _BadFileError("keeps its data in another file; export it as one .glb")
        start, length = found.get("byteOffset", 0), found["byteLength"]
        row = kind.itemsize * width
        stride = found.get("byteStride", row)
        numbers = (start, length, offset, stride, count)
        if not all(isinstance(number, int) for number in numbers) or min(numbers) < 0 or stride < row:
            raise _BadFileError("has a negative or broken offset; export it anew")
        if count and (offset + (count - 1) * stride + row > length or start + length > len(self.binary)):
            raise _BadFileError("has data beyond its end; export it anew")
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, self.binary, start + offset, (stride, kind.itemsize)).copy()

    def numbers(self, index: object, form: str, count: int | None = None) -> npt.NDArray[Any]:
        """An accessor's numbers (N, width): positions (``VEC3``) or indices (``SCALAR``).

        Args:
            index: the accessor.
            form: its type.
            count: how many there must be; needed where the file need not hold them all (sparse accessors).
        """
        accessor = self.get("accessors", index)
        kinds: dict[int, np.dtype[Any]] = {FLOAT: np.dtype("<f4")} if form == "VEC3" else INDICES
        kind, told = kinds.get(accessor["componentType"]), accessor["count"]
        if kind is None or accessor["type"] != form:
            raise _BadFileError("holds positions or indices of an unknown type; export it without compression")
        if not isinstance(told, int) or told < 0 or (count is not None and told != count):
            raise _BadFileError(f"has a target of {told} vertices where the mesh has {count}; export it anew")
        width = WIDTHS[form]
        if "bufferView" in accessor:
            values = self.slab(accessor["bufferView"], accessor.get("byteOffset", 0), kind, told, width)
        elif count is not None:
            values = np.zeros((count, width), kind)
        else:
            raise _BadFileError("has a mesh without data, perhaps a compressed one; export it without compression")
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            some, where = sparse["count"], sparse["indices"]
            kind_of_places = INDICES[where["componentType"]]
            places = self.slab(where["bufferView"], where.get("byteOffset", 0), kind_of_places, some, 1)[:, 0]
            if len(places) and places.max() >= told:
                raise _BadFileError("names a vertex that is not there; export it anew")
            told_values = sparse["values"]
            values[places] = self.slab(told_values["bufferView"], told_values.get("byteOffset", 0), kind, some, width)
        return values


def _mesh(glb: _Glb) -> GlbTargets:
    """The mesh with the most targets."""
    meshes = [mesh for mesh in glb.gltf.get("meshes", []) if mesh["primitives"][0].get("targets")]
    if not meshes:
        raise _BadFileError("no mesh in it has targets (shape keys); export them with the mesh")
    mesh = max(meshes, key=lambda one: len(one["primitives"][0]["targets"]))
    count = len(mesh["primitives"][0]["targets"])
    names = mesh.get("extras", {}).get("targetNames", [])
    if len(names) != count or not all(isinstance(name, str) for name in names):
        raise _BadFileError(f"has {count} targets and {len(names)} names for them; export it with targetNames")
    points, moves, faces, before = [], [], [], 0
    for primitive in mesh["primitives"]:
        if primitive.get("mode", TRIANGLES) != TRIANGLES or len(primitive.get("targets", [])) != count:
            raise _BadFileError("its mesh has parts that are no triangles, or have other targets; export one mesh")
        position = glb.numbers(primitive["attributes"]["POSITION"], "VEC3").astype(np.float64)
        delta = np.zeros((count, len(position), 3))
        for row, target in zip(delta, primitive["targets"], strict=True):
            if "POSITION" in target:
                row[:] = glb.numbers(target["POSITION"], "VEC3", len(position))
        if "indices" in primitive:
            corners = glb.numbers(primitive["indices"], "SCALAR")[:, 0].astype(np.int64)
        else:
            corners = np.arange(len(position))
        if len(corners) % 3 or (len(corners) and corners.max() >= len(position)):
            raise _BadFileError("its triangles name a vertex that is not there; export it anew")
        faces.append(corners.reshape(-1, 3) + before)
        points.append(position)
        moves.append(delta)
        before += len(position)
    neutral, deltas = np.concatenate(points), np.concatenate(moves, axis=1)
    if not len(neutral) or not (np.isfinite(neutral).all() and np.isfinite(deltas).all()):
        raise _BadFileError("holds no vertices, or NaN or infinity; export it anew")
    return GlbTargets(tuple(names), neutral, deltas, np.concatenate(faces))


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
