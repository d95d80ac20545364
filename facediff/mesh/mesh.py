"""Reading template meshes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError

# Reading Wavefront OBJ: every vertex in the order of the file, used by a face or not.
#
# Not through trimesh, which leaves out vertices of textured meshes that no face uses, and takes much longer.


@dataclass(frozen=True)
class ObjFile:
    """A mesh as read.

    Attributes:
        path: the file.
        vertices: (V, 3) positions.
        colours: (V, 3) vertex colours, 0 to 1; None if there are none.
        face_text: the lines of the faces, by which equal faces are told without reading them.
    """

    path: Path
    vertices: npt.NDArray[np.float64]
    colours: npt.NDArray[np.float64] | None
    face_text: bytes

    @cached_property
    def faces(self) -> npt.NDArray[np.int64] | None:
        """Triangles (F, 3); polygons become fans. None if there is none.

        Raises:
            FaceDiffError: if a face is damaged or names a vertex that is not there.
        """
        count, triangles = len(self.vertices), []
        try:
            for line in self.face_text.splitlines():
                corners = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
                corners = [corner - 1 if corner > 0 else count + corner for corner in corners]
                triangles += [(corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:], strict=True)]
        except (ValueError, IndexError) as error:
            raise FaceDiffError(f"{self.path}: not a readable OBJ mesh ({error}); write it anew") from error
        if not triangles:
            return None
        faces = np.array(triangles, np.int64)
        if faces.min() < 0 or faces.max() >= count:
            raise FaceDiffError(f"{self.path}: a face names a vertex that is not there; the file has {count} vertices")
        return faces


def read_obj(path: Path) -> ObjFile:
    """Read positions, colours and face lines of an OBJ file.

    Raises:
        FaceDiffError: if the file is missing or damaged, or holds no vertex.
    """
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected an OBJ mesh") from error
    points = [line[2:] for line in lines if line[:2] in (b"v ", b"v\t")]
    try:
        words = b" ".join(points).split()
        width = len(words) // max(1, len(points))  # colours may follow the coordinates
        if width * len(points) != len(words) or any(len(point.split()) != width for point in points[::100]):
            width, words = 3, [word for point in points for word in point.split()[:3]]
        table = np.array([float(word) for word in words]).reshape(len(points), width)
    except ValueError as error:
        raise FaceDiffError(f"{path}: not a readable OBJ mesh ({error}); write it anew") from error
    if not len(table) or width < 3:
        raise FaceDiffError(f"{path}: holds no vertices; expected an OBJ mesh with lines `v x y z`")
    text = b"\n".join(line for line in lines if line[:2] in (b"f ", b"f\t"))
    return ObjFile(path, table[:, :3].copy(), table[:, 3:6].copy() if width >= 6 else None, text)


SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) positions, in the order of the file.
        faces: (F, 3) vertex indices.
        colours: (V, 3) vertex colours, sRGB; None if the file has none.
    """

    vertices: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int32]
    colours: npt.NDArray[np.uint8] | None = None


def read_mesh(path: Path) -> Mesh:
    """Read a mesh without merging, dropping or reordering a vertex.

    Raises:
        FaceDiffError: if the file is missing, unreadable or holds no triangles.
        MissingExtraError: if trimesh is not installed.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such mesh file; expected one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".obj":
        return _read_obj(path)
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("trimesh", "train", "reading a mesh") from error
    try:
        mesh = trimesh.load(path, process=False, maintain_order=True, force="mesh")
    except Exception as error:
        raise FaceDiffError(f"{path}: not a readable mesh ({error}); expected PLY or OBJ with triangles") from error
    if not len(mesh.faces):
        raise FaceDiffError(f"{path}: holds no triangles; expected a mesh with faces")
    coloured = mesh.visual.kind == "vertex"
    return Mesh(
        np.array(mesh.vertices, np.float64),
        np.array(mesh.faces, np.int32),
        np.array(mesh.visual.vertex_colors[:, :3], np.uint8) if coloured else None,
    )


def _read_obj(path: Path) -> Mesh:
    obj = read_obj(path)
    if obj.faces is None:
        raise FaceDiffError(f"{path}: holds no triangles; expected a mesh with faces")
    colours = None if obj.colours is None else np.rint(obj.colours.clip(0, 1) * 255).astype(np.uint8)
    return Mesh(obj.vertices, obj.faces.astype(np.int32), colours)


# The area of a mesh.


def surface_area(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> float:
    """Area of a triangle mesh: vertices (V, 3), faces (F, 3); in the square of the vertices' unit, in float64.

    The sum of all vertices' mixed Voronoi areas is the same figure.
    """
    first, second, third = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    (ax, ay, az), (bx, by, bz) = (second - first).T, (third - first).T
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    return 0.5 * float(np.sqrt(square).sum())
