"""Reader of binary glTF 2.0 files: accessors, buffer views and primitives, with checked sizes.

Khronos Group, "glTF 2.0 Specification": sections 3.6 (binary data, accessors, sparse accessors), 3.7.2 (meshes) and 4.4
(GLB). :mod:`facediff.mesh.glb_scene` places the meshes. Extensions are not read, and no other file is opened. Damaged
files raise ValueError, LookupError and the like: open them within :func:`facediff.errors.damaged`.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged
from facediff.utils.numerics import Array, Indices
from facediff.utils.plain_files import parse_json, read_bytes

TYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
UNSIGNED = {code: kind for code, kind in TYPES.items() if kind.kind == "u"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
INDICES = ("u1", "u2", "u4")
POSITIONS = ("f4", "i1", "u1", "i2", "u2")  # whole numbers by the extension KHR_mesh_quantization
TRIANGLES, STRIP, FAN = 4, 5, 6
JSON, BINARY = 0x4E4F534A, 0x004E4942


class Glb:
    """The content of a binary glTF file.

    Args:
        data: the file.
        source: what messages call it.
    """

    def __init__(self, data: bytes, source: object) -> None:
        self.source = source
        self._pieces: dict[object, bytes] = {}
        if data[:8] != b"glTF\2\0\0\0":
            raise ValueError("not a binary glTF 2.0 file")
        chunks: dict[int, bytes] = {}
        at = 12
        while at + 8 <= len(data):
            size, kind = struct.unpack_from("<II", data, at)
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        self.content: dict[str, Any] = parse_json(chunks.get(JSON, b""), source, remedy="export it again")
        self.binary = chunks.get(BINARY, b"")
        packed = [name for name in self.content.get("extensionsRequired", []) if "compression" in name]
        if packed:
            # https://gltf-transform.dev/cli
            remedy = "`npx @gltf-transform/cli dequantize IN.glb OUT.glb`"
            raise ValueError(
                f"is compressed ({', '.join(packed)}): write it with {remedy}, or import it into Blender and export it "
                f"without compression"
            )

    def entries(self, kind: str, holder: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """A list of objects, such as ``nodes``, of the file or of one of its objects; empty if there is none."""
        objects: list[dict[str, Any]] = (self.content if holder is None else holder).get(kind, [])
        return objects

    def put_first(self, animation: dict[str, Any]) -> None:
        """Add an animation before the file's own: Blender and viewers start with the first one."""
        self.content["animations"] = [animation, *self.entries("animations")]
        for node in self.entries("nodes"):  # facediff's facts about the animation that was the first
            if isinstance(facts := node.get("extras"), dict) and {"frame_rate", "frames"} <= {*facts}:
                del node["extras"]

    def entry(self, kind: str, index: object) -> dict[str, Any]:
        """An object by its number; numbers from the end, which Python would accept, are refused."""
        objects: list[dict[str, Any]] = self.content.get(kind, [])
        if type(index) is not int or not 0 <= index < len(objects):
            raise ValueError(f"names {kind.removesuffix('s')} {str(index)[:20]}, which does not exist")
        return objects[index]

    def numbers(self, index: object, form: str, kinds: tuple[str, ...], count: int | None = None) -> npt.NDArray[Any]:
        """An accessor's numbers (N, width); normalised whole numbers become those from -1 to 1 that they stand for.

        Args:
            index: number of the accessor.
            form: ``VEC2``, ``VEC3``, ``VEC4``, ``MAT4`` or ``SCALAR``.
            kinds: the types of number that are allowed.
            count: how many there must be. A sparse accessor without data states no size that could be trusted.
        """
        accessor = self.entry("accessors", index)
        kind, stated, width = (
            TYPES.get(whole_number(accessor, "componentType")),
            whole_number(accessor, "count"),
            WIDTHS[form],
        )
        without_data = "bufferView" not in accessor and count is None
        if kind is None or kind.str[1:] not in kinds or accessor.get("type") != form or without_data:
            raise ValueError("holds positions or indices of an unknown type, or none: export it without compression")
        if count is not None and stated != count:
            raise ValueError(f"has a target of {stated} vertices where the mesh has {count}")
        if "bufferView" in accessor:
            values = self._slab(accessor, kind, stated, width)
        else:
            values = np.zeros((stated, width), kind)
        if "sparse" in accessor:
            sparse = accessor["sparse"]
            changed, at = whole_number(sparse, "count"), sparse["indices"]
            rows = self._slab(at, UNSIGNED[whole_number(at, "componentType")], changed, 1)[:, 0]
            values[rows] = self._slab(sparse["values"], kind, changed, width)
        if accessor.get("normalized") is True and kind.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return values

    def _slab(self, at: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> npt.NDArray[Any]:
        """Numbers (count, width) from the buffer view and offset that an object names."""
        view = self.entry("bufferViews", at.get("bufferView"))
        if whole_number(view, "buffer", 0) != 0 or "uri" in self.entry("buffers", 0):
            raise ValueError("keeps its data in another file")
        row = kind.itemsize * width
        start, offset, length = (
            whole_number(view, "byteOffset", 0),
            whole_number(at, "byteOffset", 0),
            whole_number(view, "byteLength"),
        )
        stride = whole_number(view, "byteStride", row)
        if not count:
            return np.empty((0, width), kind)
        # The last row need not be followed by its whole stride, as interleaved exporters write it.
        if stride < row or offset + (count - 1) * stride + row > length or start + length > len(self.binary):
            raise ValueError("has data beyond its end")
        return np.ndarray((count, width), kind, self.binary, start + offset, (stride, kind.itemsize)).copy()

    def piece(self, view: object) -> bytes:
        """The bytes of a buffer view, each once: many materials may name one picture."""
        entry = self.entry("bufferViews", view)
        if view not in self._pieces:
            slab = self._slab({"bufferView": view}, TYPES[5121], whole_number(entry, "byteLength"), 1)
            self._pieces[view] = slab.tobytes()
        return self._pieces[view]

    def primitives(self, mesh: int) -> list[dict[str, Any]]:
        """The parts of a mesh."""
        return self.entries("primitives", self.entry("meshes", mesh))

    def positions(self, primitive: dict[str, Any]) -> Array:
        """Vertices (V, 3) of a primitive."""
        return self.numbers(attributes(primitive).get("POSITION"), "VEC3", POSITIONS).astype(np.float64)

    def triangles(self, primitive: dict[str, Any], n_vertices: int) -> Indices:
        """Triangles (F, 3) of a primitive: a list, a strip or a fan of them."""
        mode = whole_number(primitive, "mode", TRIANGLES)
        if primitive.get("indices") is None:
            corners = np.arange(n_vertices, dtype=np.int64)
        else:
            corners = self.numbers(primitive["indices"], "SCALAR", INDICES)[:, 0].astype(np.int64)
        if len(corners) and corners.max() >= n_vertices:
            raise ValueError("its triangles name a vertex that does not exist")
        if mode == TRIANGLES:
            return corners.reshape(-1, 3)
        if mode == STRIP:
            strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1)
            # Every second triangle of a strip winds the other way round.
            strip[1::2] = strip[1::2, [1, 0, 2]]
            return strip
        if mode == FAN:
            return np.stack([np.full(max(0, len(corners) - 2), corners[:1]), corners[1:-1], corners[2:]], 1)
        return np.zeros((0, 3), np.int64)


def attributes(primitive: dict[str, Any]) -> dict[str, Any]:
    """The numbers of the accessors of a primitive's attributes, by name."""
    by_name: dict[str, Any] = primitive["attributes"]
    return by_name


def whole_number(holder: dict[str, Any], key: str, default: int | None = None) -> int:
    """A whole number that is not negative, of an object."""
    value = holder.get(key, default)
    if type(value) is not int or value < 0:
        raise ValueError(f"has the {key} {str(value)[:20]}, a negative or broken number")
    return value


def open_glb(path: Path) -> Glb:
    """The content of a .glb file."""
    return Glb(read_bytes(path, remedy="expected a .glb file"), path)


def has_materials_or_targets(path: Path) -> bool:
    """Whether a file is a .glb with materials, skins or morph targets, which a mesh alone lacks."""
    if path.suffix.lower() != ".glb":
        return False
    with suppress(FaceDiffError), damaged(path, ""):  # the reader of meshes says what is wrong
        glb = open_glb(path)
        parts = [part for mesh in range(len(glb.entries("meshes"))) for part in glb.primitives(mesh)]
        return bool(glb.entries("materials") or glb.entries("skins") or any("targets" in part for part in parts))
    return False
