"""Morph targets of binary glTF 2.0 files, which may come from anywhere: every offset and count is checked.

Khronos Group, "glTF 2.0 Specification": sections 3.6 (binary data, accessors, sparse accessors), 3.7.2 (meshes, morph
targets) and 4.4 (GLB). Names of targets are in ``mesh.extras.targetNames``, as the specification's note has it.
"""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

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
