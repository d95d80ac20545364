"""Triangle meshes: areas, and nearest points of triangles; :mod:`facediff.mesh.mesh_files` reads them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.limits import COORDINATE, in_range
from facediff.utils.numerics import Array, Floats, Integers


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh."""

    vertices: Array  # (V, 3) positions, in the order of the file
    faces: npt.NDArray[np.int32]  # (F, 3) vertex indices
    colours: npt.NDArray[np.uint8] | None = None  # (V, 3) sRGB; None if the file has none


def check_coordinates(points: Floats, source: object) -> None:
    """Refuse positions or displacements that are not finite, or so large that computing with them overflows."""
    if not in_range(points):
        raise FaceDiffError(
            f"{source} holds NaN, infinity or absurd coordinates; expected numbers up to {COORDINATE:g} in size"
        )


def triangle_areas(vertices: Floats, faces: Integers) -> Array:
    """Area (F,) of every triangle of a mesh: vertices (V, 3), faces (F, 3); in the square of the vertices' unit."""
    first, second, third = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    (ax, ay, az), (bx, by, bz) = (second - first).T, (third - first).T
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    return np.asarray(0.5 * np.sqrt(square))


def surface_area(vertices: Floats, faces: Integers) -> float:
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
