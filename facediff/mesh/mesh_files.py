"""Reader of mesh files: OBJ, PLY and binary glTF.

Every format has a parser here. Mesh libraries drop vertices, or replace them by zeros, in files that are cut short, mix
polygons, or hold textures or sparse data, and several open other files that a file names. These parsers read a file
exactly or refuse it: the counts in its header must match its data, and no other file is opened.
"""

from __future__ import annotations

import re
from codecs import BOM_UTF8
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged
from facediff.mesh.glb_scene import read_glb
from facediff.mesh.mesh import Mesh, check_coordinates
from facediff.utils.numerics import Array, Indices
from facediff.utils.plain_files import read_bytes

HEADER = 1 << 16  # bytes within which a PLY header must end

Triangles = npt.NDArray[np.int32]


def read_mesh(path: Path, *, points_allowed: bool = False) -> Mesh:
    r"""Read a mesh without merging, dropping or reordering a vertex.

    Args:
        path: an ``.obj``, ``.ply`` or ``.glb`` file.
        points_allowed: whether a file without faces is accepted; its mesh has faces of shape (0, 3).

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "square.obj"
        >>> _ = path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
        >>> read_mesh(path).faces.tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        conversion = (
            f'`blender --background --python-expr "import bpy; bpy.ops.wm.read_factory_settings(use_empty=True); '
            f"bpy.ops.import_scene.fbx(filepath='{path.name}'); "
            f"bpy.ops.export_scene.gltf(filepath='{path.stem}.glb')\"`"
        )
        advice = f"; convert it with {conversion} and give {path.stem}.glb" if suffix == ".fbx" else ""
        raise FaceDiffError(f"{path}: not a mesh format that is read; expected one of {', '.join(SUFFIXES)}{advice}")
    data = read_bytes(path, remedy="expected a mesh")
    with damaged(path, f"not a readable {suffix[1:].upper()} mesh, export it again"):
        mesh = READERS[suffix](data.removeprefix(BOM_UTF8), path)  # some editors write a mark before a text
    if not len(mesh.vertices) or not (len(mesh.faces) or points_allowed):
        lacking = "triangles" if len(mesh.vertices) else "vertices"
        raise FaceDiffError(f"{path}: holds no {lacking}; expected a mesh with vertices and faces")
    check_coordinates(mesh.vertices, f"{path}:")
    return mesh


# OBJ. For thousands of frames stored as OBJ this is several times faster than the libraries.


def _read_obj(data: bytes, path: Path) -> Mesh:
    if re.search(rb"\\\r?\n|^[ \t]", data, re.MULTILINE):  # lines that go on, and indented ones
        data = re.sub(rb"^[ \t]+", b"", re.sub(rb"\\\r?\n", b" ", data), flags=re.MULTILINE)
    lines = data.splitlines()
    rows = [line[2:].split() for line in lines if line[:2] in (b"v ", b"v\t")]
    if not rows:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    width = min(map(len, rows))
    if width != max(map(len, rows)):  # colours may follow the coordinates, of some vertices or of all
        width, rows = 3, [row[:3] for row in rows]
    table = np.array([float(word) for word in chain.from_iterable(rows)]).reshape(len(rows), width)
    face_lines = b"\n".join(line for line in lines if line[:2] in (b"f ", b"f\t"))
    # Negative numbers count back from the face's own line; with vertices after it they would name others here, where
    # all vertices are read first.
    if b" -" in face_lines or b"\t-" in face_lines:
        kinds = b"".join(line[:1] for line in lines if line[:2] in (b"v ", b"v\t", b"f ", b"f\t"))
        if b"fv" in kinds:
            raise ValueError("faces between its vertices count backwards from where they stand")
    colours = _colours(table[:, 3:6]) if width >= 6 else None
    return Mesh(table[:, [0, 1, 2]], _triangles(face_lines, len(table)).copy(), colours)


def _colours(shares: Array) -> npt.NDArray[np.uint8]:
    """Colours (V, 3) of a text file, from 0 to 1 or to 255."""
    if not np.isfinite(shares).all():
        raise ValueError("colours are not finite")
    if shares.max(initial=0) >= 2:  # some tools write bytes; a little above 1 is a rounding
        shares = shares / 255
    return np.rint(shares.clip(0, 1) * 255).astype(np.uint8)


# The frames of a sequence and the shapes of a set repeat the same face lines, and parsing them takes most of the time.
@lru_cache(maxsize=2)
def _triangles(lines: bytes, n_vertices: int) -> Triangles:
    """Triangles (F, 3) of an OBJ's face lines; polygons become fans."""
    triangles = []
    for line in lines.splitlines():
        corners = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
        corners = [corner - 1 if corner > 0 else n_vertices + corner for corner in corners]
        triangles += [(corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:], strict=True)]
    return _checked(np.array(triangles, np.int64), n_vertices)


def _checked(faces: Indices, n_vertices: int) -> Triangles:
    """Triangles as (F, 3), refused if a vertex does not exist."""
    if faces.size and (faces.min() < 0 or faces.max() >= n_vertices):
        raise ValueError(f"a face names a vertex that does not exist among {n_vertices}")
    return faces.reshape(-1, 3).astype(np.int32)


def _cut(polygons: npt.NDArray[Any] | Sequence[Sequence[int]], n_vertices: int) -> Triangles:
    """Triangles of polygons: first triangles, then both halves of quadrangles, then fans of larger polygons."""
    if isinstance(polygons, np.ndarray):  # all of one length
        lengths = np.full(len(polygons), polygons.shape[1], np.int64)
    else:
        lengths = np.array([len(polygon) for polygon in polygons], np.int64)
    parts = [np.zeros((0, 3), np.int64)]
    for length in (3, 4):
        rows = np.flatnonzero(lengths == length)
        if len(rows):
            corners = polygons[rows] if isinstance(polygons, np.ndarray) else [polygons[int(i)] for i in rows]
            table = np.asarray(corners, np.int64)
            parts += [table[:, :3]] if length == 3 else [table[:, :3], table[:, [2, 3, 0]]]
    for i in np.flatnonzero(lengths > 4):
        corners = np.asarray(polygons[int(i)], np.int64)
        parts.append(np.stack([np.broadcast_to(corners[0], len(corners) - 2), corners[1:-1], corners[2:]], 1))
    return _checked(np.concatenate(parts), n_vertices)


# PLY.

_PLY_TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"int64": "i8", "uint64": "u8", "float": "f4", "double": "f8", "float16": "f2", "float32": "f4", "float64": "f8"},
}


@dataclass
class _Element:
    """A kind of rows in a PLY file: how many there are, and their columns."""

    name: str
    count: int
    # Of each property its name, the type of its values, and for a list the type of its length.
    properties: list[tuple[str, str, str | None]] = field(default_factory=list)


def _read_ply(data: bytes, path: Path) -> Mesh:
    end = re.search(rb"^end_header[ \t]*\r?\n", data[:HEADER], re.MULTILINE)
    if not data.startswith(b"ply") or end is None:
        raise ValueError("its header is not that of a PLY file, or does not end")
    elements, form = _ply_header(data[: end.start()].decode("latin-1").split("\n"))
    body = memoryview(data)[end.end() :]
    columns = _ply_text(elements, bytes(body).split()) if form == "ascii" else _ply_binary(elements, body)
    vertex = columns["vertex"]
    points: Array = np.stack([np.asarray(vertex[axis], np.float64) for axis in "xyz"], 1)
    faces = columns.get("face", {})
    names = [name for name in faces if name in ("vertex_index", "vertex_indices") or len(faces) == 1]
    types = {name: kind for element in elements if element.name == "vertex" for name, kind, _ in element.properties}
    colours = None
    if {"red", "green", "blue"} <= vertex.keys():
        table = np.stack([np.asarray(vertex[name], np.float64) for name in ("red", "green", "blue")], 1)
        kind = types["red"][1:]  # after the order of its bytes
        if kind == "u2" or (kind[0] == "f" and table.max(initial=0) <= 1):  # some tools write bytes as floats
            table *= 255 / (65535 if kind == "u2" else 1)
        colours = np.rint(table.clip(0, 255)).astype(np.uint8)
    return Mesh(points, _cut(faces[names[0]] if names else [], len(points)), colours)


def _ply_header(lines: list[str]) -> tuple[list[_Element], str]:
    elements: list[_Element] = []
    form = ""
    for line in lines[1:]:
        match line.split():
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, *_]:
                pass
            case ["element", name, count] if count.isdecimal():
                elements.append(_Element(name, int(count)))
            case ["property", "list", length, kind, name] if elements and length in _PLY_TYPES and kind in _PLY_TYPES:
                elements[-1].properties.append((name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                elements[-1].properties.append((name, _PLY_TYPES[kind], None))
            case [] | ["comment" | "obj_info", *_]:
                pass
            case _:
                raise ValueError(f"its header has the line {line[:60]!r}")
    if not form or any(element.count and not element.properties for element in elements):
        raise ValueError("its header names no known format, or rows without properties")
    order = ">" if form == "binary_big_endian" else "<"
    for element in elements:
        element.properties = [
            (name, order + kind, length and order + length) for name, kind, length in element.properties
        ]
    return elements, form


Columns = dict[str, Any]  # by property: an array of numbers, or a sequence of lists


def _ply_binary(elements: list[_Element], body: memoryview) -> dict[str, Columns]:
    columns: dict[str, Columns] = {}
    at = 0
    for element in elements:
        columns[element.name], at = _ply_rows(element, body, at)
    if at != len(body):
        raise ValueError(f"it holds {len(body) - at} bytes more than its header declares")
    return columns


def _ply_rows(element: _Element, body: memoryview, at: int) -> tuple[Columns, int]:
    """The columns of an element that starts at byte ``at``, and where it ends."""
    if not element.count:
        return {}, at
    # Nearly all files have lists of one length, triangles, so that the first row tells the size of all.
    first, _ = _ply_row(element, body, at)
    fields: list[tuple[str, Any]] = []
    for number, ((_, kind, length), value) in enumerate(zip(element.properties, first, strict=True)):
        if length is not None:
            fields.append((f"length{number}", length))
        fields.append((f"value{number}", kind if length is None else (kind, (len(value),))))
    row = np.dtype(fields)
    if element.count * row.itemsize <= len(body) - at:
        table = np.frombuffer(body, row, element.count, at)
        if all(
            (table[f"length{i}"] == len(first[i])).all()
            for i, (_, _, length) in enumerate(element.properties)
            if length is not None
        ):
            columns = {name: table[f"value{number}"] for number, (name, _, _) in enumerate(element.properties)}
            return columns, at + element.count * row.itemsize
    lists: Columns = {name: [] for name, _, _ in element.properties}
    for _ in range(element.count):
        values, at = _ply_row(element, body, at)
        for (name, _, _), value in zip(element.properties, values, strict=True):
            lists[name].append(value)
    return lists, at


def _ply_row(element: _Element, body: memoryview, at: int) -> tuple[list[Any], int]:
    values: list[Any] = []
    for _, kind, length in element.properties:
        count = 1
        if length is not None:
            count, at = int(np.frombuffer(body, length, 1, at)[0]), at + np.dtype(length).itemsize
        size = count * np.dtype(kind).itemsize
        if count < 0 or at + size > len(body):
            raise ValueError(f"it is cut short: a list of {element.name} is not all there")
        value = np.frombuffer(body, kind, count, at) if count else np.empty(0, kind)
        values.append(value[0] if length is None else value)
        at += size
    return values, at


def _ply_text(elements: list[_Element], cells: list[bytes]) -> dict[str, Columns]:
    columns: dict[str, Columns] = {}
    tokens = iter(cells)
    try:
        for element in elements:
            rows: Columns = {name: [] for name, _, _ in element.properties}
            for _ in range(element.count if rows else 0):
                for name, kind, length in element.properties:
                    number = float if length is None or kind[1] == "f" else int
                    values = [number(next(tokens)) for _ in range(1 if length is None else int(next(tokens)))]
                    rows[name].append(values if length is not None else values[0])
            for name, kind, length in element.properties:
                if length is None and kind[1] == "f":
                    with np.errstate(over="ignore"):  # a number beyond a float becomes infinite, and is refused later
                        rows[name] = np.array(rows[name]).astype(kind)
            columns[element.name] = rows if element.count else {}
    except StopIteration as error:
        raise ValueError("it is cut short: its rows are not all there") from error
    if next(tokens, None) is not None:
        raise ValueError("it holds more numbers than its header declares")
    return columns


READERS: dict[str, Callable[[bytes, Path], Mesh]] = {
    ".ply": _read_ply,
    ".obj": _read_obj,
    ".glb": read_glb,
}
SUFFIXES = tuple(READERS)
