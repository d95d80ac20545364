"""Points of a surface as weighted means of the corners of a coarser surface's faces."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]


def project(points: Array, coarse: Array, faces: Indices, clusters: Indices) -> tuple[Indices, Array]:
    """The nearest point on a coarse mesh, by the corners of its face.

    Looked for among the faces at the coarse vertex that a point belongs to and at that one's neighbours. Where there
    are no such faces, the coarse vertex itself is taken.

    Args:
        points: (V, 3).
        coarse: (M, 3) vertices of the coarse mesh.
        faces: (G, 3) its faces.
        clusters: (V,) the coarse vertex that each point belongs to.

    Returns:
        corners (V, 3) and their weights (V, 3), none negative, which sum to one; equal points choose the first face.
    """
    corners = np.repeat(clusters[:, None], 3, axis=1)
    weights = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    if not len(faces):
        return corners, weights
    starts, around = _faces_around(faces, len(coarse))
    count = np.diff(starts)[clusters]
    point = np.repeat(np.arange(len(points)), count)
    first = np.repeat(np.cumsum(count) - count, count)
    face = around[np.repeat(starts[clusters], count) + np.arange(len(point)) - first]
    share, square = closest_on_triangles(points[point], coarse[faces[face]])
    order = np.lexsort((face, square, point))
    found, best = np.unique(point[order], return_index=True)
    best = order[best]
    corners[found], weights[found] = faces[face[best]], share[best]
    return corners, weights


def _faces_around(faces: Indices, n_vertices: int) -> tuple[Indices, Indices]:
    """Faces that touch each vertex or one of its neighbours: where each vertex's list starts, and the lists."""
    ring = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    ring = np.unique(np.concatenate([ring, ring[:, ::-1], np.repeat(np.arange(n_vertices)[:, None], 2, 1)]), axis=0)
    corner, face = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    order = np.argsort(corner, kind="stable")
    starts = np.searchsorted(corner[order], np.arange(n_vertices + 1))
    count = np.diff(starts)[ring[:, 1]]
    vertex = np.repeat(ring[:, 0], count)
    offset = np.arange(len(vertex)) - np.repeat(np.cumsum(count) - count, count)
    touching = face[order][np.repeat(starts[ring[:, 1]], count) + offset]
    pairs = np.unique(vertex * len(faces) + touching)
    return np.searchsorted(pairs // len(faces), np.arange(n_vertices + 1)), pairs % len(faces)


def closest_on_triangles(points: Array, triangles: Array) -> tuple[Array, Array]:
    """The point of each triangle (N, 3, 3) nearest to each point (N, 3): weights (N, 3) and squared distances (N,).

    The nearest point lies inside or on an edge: of the foot of the perpendicular, where it is inside, and the nearest
    points of the three edges, the nearest counts.
    """
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    best, square = _on_edges(points, triangles)
    ab, ac, ap = b - a, c - a, points - a
    d00, d01, d11 = (_dot(x, y) for x, y in ((ab, ab), (ab, ac), (ac, ac)))
    d20, d21 = _dot(ap, ab), _dot(ap, ac)
    area = d00 * d11 - d01 * d01
    flat = area <= 1e-12 * d00 * d11  # no normal to speak of: an edge does
    area = np.where(flat, 1.0, area)
    v, w = (d11 * d20 - d01 * d21) / area, (d00 * d21 - d01 * d20) / area
    inside = ~flat & (v >= 0) & (w >= 0) & (v + w <= 1)
    foot = np.stack([1 - v - w, v, w], axis=1)
    away = np.square(ap - v[:, None] * ab - w[:, None] * ac).sum(axis=1)
    better = inside & (away < square)
    return np.where(better[:, None], foot, best), np.where(better, away, square)


def _on_edges(points: Array, triangles: Array) -> tuple[Array, Array]:
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
    return best, square


def _dot(x: Array, y: Array) -> Array:
    product: Array = np.einsum("ij,ij->i", x, y)
    return product
