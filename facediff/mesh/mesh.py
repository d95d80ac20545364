"""Triangle meshes: the one reader of mesh files, areas, and nearest points of triangles."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError

Array = npt.NDArray[np.float64]

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


def read_mesh(path: Path, *, points_allowed: bool = False) -> Mesh:
    r"""Read a mesh without merging, dropping or reordering a vertex.

    Args:
        path: an ``.obj``, ``.ply``, ``.stl``, ``.off`` or ``.glb`` file.
        points_allowed: whether an ``.obj`` without faces is accepted; its mesh has faces of shape (0, 3).

    Raises:
        FaceDiffError: if the file is missing or damaged, or holds no vertices or no triangles.
        MissingExtraError: if trimesh is not installed.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "square.obj"
        >>> _ = path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nf 1 2 3 4\n")
        >>> read_mesh(path).faces.tolist()
        [[0, 1, 2], [0, 2, 3]]
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such mesh file; expected one of {', '.join(SUFFIXES)}")
    mesh = _read_obj(path) if path.suffix.lower() == ".obj" else _read_with_trimesh(path)
    if not len(mesh.faces) and not points_allowed:
        raise FaceDiffError(f"{path}: holds no triangles; expected a mesh with faces")
    return mesh


def _read_with_trimesh(path: Path) -> Mesh:
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("trimesh", "train", "reading a mesh") from error
    try:
        mesh = trimesh.load(path, process=False, maintain_order=True, force="mesh")
    except Exception as error:
        raise FaceDiffError(f"{path}: not a readable mesh ({error}); expected PLY or OBJ with triangles") from error
    coloured = mesh.visual.kind == "vertex"
    return Mesh(
        np.array(mesh.vertices, np.float64),
        np.array(mesh.faces, np.int32),
        np.array(mesh.visual.vertex_colors[:, :3], np.uint8) if coloured else None,
    )


def _read_obj(path: Path) -> Mesh:
    # trimesh drops the vertices of a textured mesh that no face uses, which would shift all indices after them; for
    # thousands of frames stored as OBJ it is also several times slower than this.
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
        raise FaceDiffError(f"{path}: not a readable OBJ mesh ({error}); write it again") from error
    if not len(table) or width < 3:
        raise FaceDiffError(f"{path}: holds no vertices; expected an OBJ mesh with lines `v x y z`")
    try:
        faces = _triangles(b"\n".join(line for line in lines if line[:2] in (b"f ", b"f\t")), len(table))
    except (ValueError, IndexError) as error:
        raise FaceDiffError(f"{path}: not a readable OBJ mesh ({error}); write it again") from error
    colours = np.rint(table[:, 3:6].clip(0, 1) * 255).astype(np.uint8) if width >= 6 else None
    return Mesh(table[:, :3].copy(), faces.copy(), colours)


# The frames of a sequence and the shapes of a set repeat the same face lines, and parsing them takes most of the time.
@lru_cache(maxsize=2)
def _triangles(lines: bytes, n_vertices: int) -> npt.NDArray[np.int32]:
    """Triangles (F, 3) of an OBJ's face lines; polygons become fans; ValueError if a line is damaged."""
    triangles = []
    for line in lines.splitlines():
        corners = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
        corners = [corner - 1 if corner > 0 else n_vertices + corner for corner in corners]
        triangles += [(corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:], strict=True)]
    faces = np.array(triangles, np.int64).reshape(-1, 3)
    if faces.size and (faces.min() < 0 or faces.max() >= n_vertices):
        raise ValueError(f"a face names a vertex that does not exist among {n_vertices}")
    return faces.astype(np.int32)


def triangle_areas(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """Area (F,) of every triangle of a mesh: vertices (V, 3), faces (F, 3); in the square of the vertices' unit."""
    first, second, third = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    (ax, ay, az), (bx, by, bz) = (second - first).T, (third - first).T
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    return np.asarray(0.5 * np.sqrt(square))


def surface_area(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> float:
    """Area of a triangle mesh, which is also the sum of its vertices' mixed Voronoi areas."""
    return float(triangle_areas(vertices, faces).sum())


def closest_on_triangles(points: Array, triangles: Array) -> tuple[Array, Array]:
    """The point of each triangle (N, 3, 3) nearest to each point (N, 3): weights (N, 3) and squared distances (N,).

    Weights are none negative and sum to one, also for triangles without an area.
    """
    # trimesh finds the same points, but its barycentric weights may be negative, and NaN for degenerate triangles.
    # The nearest point lies inside or on an edge: of the foot of the perpendicular, where it is inside, and the nearest
    # points of the three edges, the nearest counts.
    best, square = np.zeros((len(points), 3)), np.full(len(points), np.inf)
    for i, j in ((0, 1), (1, 2), (2, 0)):
        start, along = triangles[:, i], triangles[:, j] - triangles[:, i]
        length = np.maximum(_dot(along, along), np.finfo(float).tiny)
        part = np.clip(_dot(points - start, along) / length, 0.0, 1.0)
        away = np.square(points - start - part[:, None] * along).sum(axis=1)
        better = away < square
        square[better] = away[better]
        best[better] = 0.0
        best[better, i], best[better, j] = 1.0 - part[better], part[better]
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (_dot(x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = d00 * d11 - d01 * d01
    flat = area <= 1e-12 * d00 * d11  # too thin for a reliable normal: an edge is as near
    area = np.where(flat, 1.0, area)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
    foot = np.stack([1 - v - w, v, w], axis=1)
    away = np.square(ap - v[:, None] * ab - w[:, None] * ac).sum(axis=1)
    better = inside & (away < square)
    return np.where(better[:, None], foot, best), np.where(better, away, square)


def _dot(x: Array, y: Array) -> Array:
    return np.asarray(np.einsum("ij,ij->i", x, y))
