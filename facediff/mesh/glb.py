"""Binary glTF 2.0 files from elsewhere: their data, checked before it is believed, and the mesh that they show.

Khronos Group, "glTF 2.0 Specification": sections 3.5 (scenes, nodes, transforms), 3.6 (binary data, accessors, sparse
accessors), 3.7.2 (meshes) and 4.4 (GLB). Images, materials and extensions are not read, and no other file is opened.
"""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.mesh.mesh import Array, Mesh
from facediff.utils.limits import LIMITS
from facediff.utils.plain_files import parse_json

TYPES: dict[int, np.dtype[Any]] = {
    5120: np.dtype("i1"),
    5121: np.dtype("u1"),
    5122: np.dtype("<i2"),
    5123: np.dtype("<u2"),
    5125: np.dtype("<u4"),
    5126: np.dtype("<f4"),
}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
INDICES = ("u1", "u2", "u4")
POSITIONS = ("f4", "i1", "u1", "i2", "u2")  # whole numbers by the extension KHR_mesh_quantization
TRIANGLES, STRIP, FAN = 4, 5, 6
JSON, BINARY = 0x4E4F534A, 0x004E4942


class Glb:
    """The content of a binary glTF file.

    Args:
        data: the file.
        source: what messages call it.

    Raises:
        ValueError: if it is no such file, or damaged; so do all methods.
        FaceDiffError: if it is larger than the budget.
    """

    def __init__(self, data: bytes, source: object) -> None:
        self.source = source
        if data[:8] != b"glTF\2\0\0\0":
            raise ValueError("not a binary glTF 2.0 file")
        chunks: dict[int, bytes] = {}
        at = 12
        while at + 8 <= len(data):
            size, kind = struct.unpack_from("<II", data, at)
            if at + 8 + size > len(data):
                raise ValueError("has data beyond its end")
            chunks.setdefault(kind, data[at + 8 : at + 8 + size])
            at += 8 + size
        self.content = parse_json(chunks.get(JSON, b""), source, remedy="export it again")
        self.binary = chunks.get(BINARY, b"")
        if not isinstance(self.content, dict):
            raise ValueError("has no description of its content")
        needed = self.content.get("extensionsRequired", [])
        packed = [str(name) for name in needed if "compression" in str(name)] if isinstance(needed, list) else []
        if packed:
            raise ValueError(f"is compressed ({', '.join(packed)}): export it without compression")
        self._expanded = 0  # bytes of all accessors that were read: many may share the same data

    def entries(self, kind: str, holder: dict[str, Any] | None = None) -> list[dict[str, Any]]:
        """A list of objects, such as ``nodes``, of the file or of one of its objects; empty if there is none."""
        listed = (self.content if holder is None else holder).get(kind, [])
        if not isinstance(listed, list) or not all(isinstance(entry, dict) for entry in listed):
            raise ValueError(f"has {kind} that are no list of objects")
        return listed

    def entry(self, kind: str, index: object) -> dict[str, Any]:
        """An object by its number; numbers from the end, which Python would accept, are refused."""
        listed = self.entries(kind)
        if type(index) is not int or not 0 <= index < len(listed):
            raise ValueError(f"names {kind.removesuffix('s')} {str(index)[:20]}, which does not exist")
        return listed[index]

    def numbers(self, index: object, form: str, kinds: tuple[str, ...], count: int | None = None) -> npt.NDArray[Any]:
        """An accessor's numbers (N, width); normalised whole numbers become those from -1 to 1 that they stand for.

        Args:
            index: number of the accessor.
            form: ``VEC3``, ``VEC4`` or ``SCALAR``.
            kinds: the types of number that are allowed.
            count: how many there must be. A sparse accessor without data states no size that could be trusted.
        """
        accessor = self.entry("accessors", index)
        kind, stated, width = TYPES.get(_whole(accessor, "componentType")), _whole(accessor, "count"), WIDTHS[form]
        if kind is None or kind.str[1:] not in kinds or accessor.get("type") != form:
            raise ValueError("holds positions or indices of an unknown type: export it without compression")
        if count is not None and stated != count:
            raise ValueError(f"has a target of {stated} vertices where the mesh has {count}")
        LIMITS.check("vertices", stated if width > 1 else stated // 3, self.source)
        self._expanded += stated * width * 8
        LIMITS.check("bytes", self._expanded, self.source)
        if "bufferView" in accessor:
            values = self._slab(accessor, kind, stated, width)
        elif count is not None:
            values = np.zeros((count, width), kind)
        else:
            raise ValueError("has a mesh without data, perhaps a compressed one: export it without compression")
        sparse = accessor.get("sparse")
        if sparse is not None:
            if not isinstance(sparse, dict):
                raise ValueError("has a broken sparse accessor")
            changed = _whole(sparse, "count")
            at, new = sparse.get("indices"), sparse.get("values")
            if not isinstance(at, dict) or not isinstance(new, dict):
                raise ValueError("has a broken sparse accessor")
            type_of_places = TYPES.get(_whole(at, "componentType"))
            if type_of_places is None or type_of_places.str[1:] not in INDICES:
                raise ValueError("has a broken sparse accessor")
            places = self._slab(at, type_of_places, changed, 1)[:, 0]
            if len(places) and places.max() >= stated:
                raise ValueError("names a vertex that does not exist")
            values[places] = self._slab(new, kind, changed, width)
        if accessor.get("normalized") is True and kind.kind in "iu":
            return np.maximum(values.astype(np.float64) / np.iinfo(kind).max, -1.0)
        return values

    def _slab(self, at: dict[str, Any], kind: np.dtype[Any], count: int, width: int) -> npt.NDArray[Any]:
        """Numbers (count, width) from the buffer view and offset that an object names."""
        view = self.entry("bufferViews", at.get("bufferView"))
        if _whole(view, "buffer", 0) != 0 or "uri" in self.entry("buffers", 0):
            raise ValueError("keeps its data in another file")
        row = kind.itemsize * width
        start, offset, length = _whole(view, "byteOffset", 0), _whole(at, "byteOffset", 0), _whole(view, "byteLength")
        stride = _whole(view, "byteStride", row)
        if stride < row:
            raise ValueError("has a negative or broken offset")
        if not count:
            return np.empty((0, width), kind)
        if offset + (count - 1) * stride + row > length or start + length > len(self.binary):
            raise ValueError("has data beyond its end")
        return np.ndarray((count, width), kind, self.binary, start + offset, (stride, kind.itemsize)).copy()

    def primitives(self, mesh: int) -> list[dict[str, Any]]:
        """The parts of a mesh."""
        return self.entries("primitives", self.entry("meshes", mesh))

    def positions(self, primitive: dict[str, Any]) -> Array:
        """Vertices (V, 3) of a primitive."""
        return self.numbers(attributes(primitive).get("POSITION"), "VEC3", POSITIONS).astype(np.float64)

    def triangles(self, primitive: dict[str, Any], n_vertices: int) -> npt.NDArray[np.int64]:
        """Triangles (F, 3) of a primitive: a list, a strip or a fan of them."""
        mode = _whole(primitive, "mode", TRIANGLES)
        if primitive.get("indices") is None:
            corners = np.arange(n_vertices, dtype=np.int64)
        else:
            corners = self.numbers(primitive["indices"], "SCALAR", INDICES)[:, 0].astype(np.int64)
        if len(corners) and corners.max() >= n_vertices:
            raise ValueError("its triangles name a vertex that does not exist")
        if mode == TRIANGLES:
            if len(corners) % 3:
                raise ValueError("its last triangle is not complete")
            return corners.reshape(-1, 3)
        if mode == STRIP:
            strip = np.stack([corners[:-2], corners[1:-1], corners[2:]], 1)
            strip[1::2] = strip[1::2, [1, 0, 2]]
            return strip
        if mode == FAN:
            return np.stack([np.full(max(0, len(corners) - 2), corners[:1]), corners[1:-1], corners[2:]], 1)
        return np.zeros((0, 3), np.int64)


def attributes(primitive: dict[str, Any]) -> dict[str, Any]:
    """Which accessor holds which of a primitive's attributes."""
    found = primitive.get("attributes")
    if not isinstance(found, dict):
        raise ValueError("has a mesh without attributes")
    return found


def _whole(holder: dict[str, Any], key: str, default: int | None = None) -> int:
    value = holder.get(key, default)
    if type(value) is not int or value < 0:
        raise ValueError(f"has the {key} {str(value)[:20]}, a negative or broken number")
    return value


def open_glb(path: Path) -> Glb:
    """A file from elsewhere, within the budget.

    Raises:
        FaceDiffError: if it cannot be read, or needs more than the budget.
        ValueError: saying what is wrong with its content.
    """
    try:
        LIMITS.check("bytes", path.stat().st_size, path)
        data = path.read_bytes()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected a .glb file") from error
    return Glb(data, path)


def read_glb(data: bytes, source: object) -> Mesh:
    """All meshes of a file's scene as one, each where its nodes place it.

    Raises:
        ValueError: if the file is damaged.
        FaceDiffError: if it is larger than the budget.
    """
    glb = Glb(data, source)
    placed = placed_meshes(glb)
    parts: dict[int, list[tuple[Array, npt.NDArray[np.int64], Any]]] = {}
    points, faces, colours, before, triangles = [np.zeros((0, 3))], [np.zeros((0, 3), np.int64)], [], 0, 0
    for index, matrix, _ in placed:
        if index not in parts:
            parts[index] = [_primitive(glb, each) for each in glb.primitives(index)]
        for position, corners, colour in parts[index]:
            if not len(corners):
                continue  # points and lines
            LIMITS.check("vertices", before + len(position), source)
            LIMITS.check("vertices", triangles + len(corners), source)
            points.append(position if matrix is None else position @ matrix[:3, :3].T + matrix[:3, 3])
            mirrored = matrix is not None and np.linalg.det(matrix[:3, :3]) < 0
            faces.append((corners[:, ::-1] if mirrored else corners) + before)
            colours.append(colour)
            before += len(position)
            triangles += len(corners)
    coloured = bool(colours) and all(colour is not None for colour in colours)
    return Mesh(
        np.concatenate(points), np.concatenate(faces).astype(np.int32), np.concatenate(colours) if coloured else None
    )


def _primitive(glb: Glb, primitive: dict[str, Any]) -> tuple[Array, npt.NDArray[np.int64], Any]:
    position = glb.positions(primitive)
    color, colour = attributes(primitive).get("COLOR_0"), None
    if color is not None and "material" not in primitive:  # a material tints the colours, which then are not the face's
        form = "VEC4" if glb.entry("accessors", color).get("type") == "VEC4" else "VEC3"
        values = glb.numbers(color, form, ("f4", "u1", "u2"), len(position))[:, :3]
        scale = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
        colour = np.rint(255 * np.clip(np.nan_to_num(values / scale), 0, 1)).astype(np.uint8)
    return position, glb.triangles(primitive, len(position)), colour


def placed_meshes(glb: Glb) -> list[tuple[int, Array | None, int]]:
    """The scene's meshes with the (4, 4) matrices that place them, None for one that stays, and their nodes or -1."""
    scenes, nodes = glb.entries("scenes"), glb.entries("nodes")
    if scenes:
        roots = glb.entry("scenes", glb.content.get("scene", 0)).get("nodes", [])
    else:
        below = {child for node in nodes for child in _list(node.get("children", [])) if type(child) is int}
        roots = [index for index in range(len(nodes)) if index not in below]
    if not nodes:
        return [(index, None, -1) for index in range(len(glb.entries("meshes")))]
    placed: list[tuple[int, Array | None, int]] = []
    seen: set[int] = set()
    queue: list[tuple[object, Array | None]] = [(root, None) for root in _list(roots)]
    while queue:
        index, parent = queue.pop()
        node = glb.entry("nodes", index)
        assert isinstance(index, int)  # noqa: S101 - for type checkers: glb.entry refuses anything else
        if index in seen:
            raise ValueError(f"its node {index} is below two others, or below itself")
        seen.add(index)
        own = _matrix(node)
        matrix = own if parent is None else parent if own is None else parent @ own
        queue += [(child, matrix) for child in _list(node.get("children", []))]
        if "mesh" in node:
            placed.append((_whole(node, "mesh"), matrix, index))
    return placed


def _list(value: object) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError("has a list of nodes that is none")
    return value


def _matrix(node: dict[str, Any]) -> Array | None:
    """A node's transform (4, 4); None if it has none."""
    if not {"matrix", "translation", "rotation", "scale"} & node.keys():
        return None

    def given(key: str, default: list[float]) -> Array:
        values = node.get(key, default)
        if not isinstance(values, list) or len(values) != len(default):
            raise ValueError(f"a node's {key} has not {len(default)} numbers")
        if not all(type(value) in (int, float) for value in values):
            raise ValueError(f"a node's {key} holds no numbers")
        return np.array(values, np.float64)

    matrix = given("matrix", np.eye(4).ravel().tolist()).reshape(4, 4).T.copy()
    rotation = given("rotation", [0, 0, 0, 1])
    x, y, z, w = rotation / max(float(np.linalg.norm(rotation)), 1e-30)
    turn = np.eye(4)
    turn[:3, :3] = np.eye(3) + 2 * np.array(
        [[-y * y - z * z, x * y - z * w, x * z + y * w], [x * y + z * w, -x * x - z * z, y * z - x * w],
         [x * z - y * w, y * z + x * w, -x * x - y * y]]
    )  # fmt: skip
    move = np.eye(4)
    move[:3, 3] = given("translation", [0, 0, 0])
    return np.asarray(matrix @ move @ turn @ np.diag([*given("scale", [1, 1, 1]), 1.0]))
