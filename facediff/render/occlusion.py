"""Ambient occlusion: how much of the sky each vertex of a mesh at rest sees.

:data:`facediff.export.viewer` does the same in the browser, in ``assets/occlusion.js``.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.render.meshes import Faces, Float64, VertexSums, vertex_normals

CELLS = 96  # Cells of a depth map along the longest side of the mesh
AXES = 24  # Lines of sight, each of which is looked along both ways
LIFT = 0.5  # Depth, in cells, that a surface may lie in front of a vertex without hiding it
KEPT = 0.4  # Light that is left where nothing of the sky is seen: it comes from the skin around
HIDDEN = 0.1  # A piece that nowhere sees more of the sky than this lies inside the mesh
THROUGH_OPENING = 0.45  # Share of the sky that the edge of upper teeth sees between open lips


def sky_seen(vertices: npt.NDArray[np.floating[Any]], faces: npt.NDArray[np.integer[Any]]) -> Float64:
    """Share of the sky over each vertex (V,) that no other part of the mesh hides, weighted by the cosine; 1 if all.

    The mesh is looked at along evenly spread lines; a vertex is hidden where the depth map of a line has something in
    front of it (Zhukov et al., "An ambient light illumination model", 1998, for the quantity). On a convex body nothing
    hides anything, at any resolution.

    Args:
        vertices: (V, 3), in any unit.
        faces: triangles (F, 3), counter-clockwise seen from outside.
    """
    points = np.asarray(vertices, np.float64)
    # Only drawn vertices matter: a lost vertex must not set the scale.
    drawn_points = points[np.unique(faces)]
    cell = max(float(np.ptp(drawn_points, axis=0).max()) / CELLS, 1e-12)
    samples = _surface(points, faces, cell)
    normals = vertex_normals(points, np.asarray(faces, np.int32))
    visible, sky = np.zeros(len(points)), np.zeros(len(points))
    width = int(2 * CELLS)  # enough for a diagonal of the box, seen from anywhere
    middle = (drawn_points.min(axis=0) + drawn_points.max(axis=0)) / 2
    for axis in lines_of_sight(AXES):
        across = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[1]) < 0.9 else [1.0, 0.0, 0.0])
        across /= np.linalg.norm(across)
        frame = np.stack([across, np.cross(axis, across), axis], axis=1)
        u, v, depth = ((samples - middle) @ frame).T
        sample_cells = _cells(u, v, cell, width)
        vertex_points = (points - middle) @ frame
        vertex_cells = _cells(vertex_points[:, 0], vertex_points[:, 1], cell, width)
        for sign in (1.0, -1.0):
            nearest = np.full(width * width, -np.inf)
            np.maximum.at(nearest, sample_cells, sign * depth)
            cosine = sign * (normals @ axis)
            weight = np.where(cosine > 0.15, cosine, 0.0)
            # Within a cell a plane that is seen at an angle rises by its tangent.
            rise = np.sqrt(2.0) * cell * np.sqrt(1.0 - np.minimum(cosine**2, 1.0)) / np.maximum(cosine, 0.15)
            open_sky = sign * vertex_points[:, 2] + rise + LIFT * cell >= nearest[vertex_cells]
            visible += weight * open_sky
            sky += weight
    share = np.where(sky > 0, visible / np.maximum(sky, 1e-12), 1.0)
    # The lines are few: the mean of the triangles round a vertex takes their stripes away.
    sums = VertexSums(np.asarray(faces, np.int32), len(points))
    around = sums(np.repeat(share[faces].mean(axis=1)[:, None], 3, axis=1))[:, 0] / sums.counts[:, 0]
    return np.asarray(np.where(np.isin(np.arange(len(points)), faces), around, 1.0))


def occlusion(vertices: npt.NDArray[np.floating[Any]], faces: npt.NDArray[np.integer[Any]]) -> npt.NDArray[np.float32]:
    """Share of its light that each vertex (V,) of a mesh at rest keeps; a mesh that was seen lately costs nothing."""
    points, triangles = np.ascontiguousarray(vertices, np.float32), np.ascontiguousarray(faces, np.int32)
    return _remembered(points.tobytes(), triangles.tobytes())


@lru_cache(maxsize=32)
def _remembered(points: bytes, triangles: bytes) -> npt.NDArray[np.float32]:
    faces: Faces = np.frombuffer(triangles, np.int32).reshape(-1, 3)
    seen = sky_seen(np.frombuffer(points, np.float32).reshape(-1, 3), faces)
    seen[_inside(seen, faces)] = THROUGH_OPENING  # such pieces are seen only once a mouth opens
    return np.asarray(KEPT + (1 - KEPT) * seen, np.float32)


def _inside(seen: Float64, faces: Faces) -> npt.NDArray[np.bool_]:
    """Whether each vertex (V,) is of a piece inside a mesh at rest, as teeth are: nothing of it sees the sky."""
    outside, count = seen > HIDDEN, -1
    while count != (count := int(outside.sum())):
        outside[faces[outside[faces].any(axis=1)]] = True
    return ~outside


def lines_of_sight(count: int) -> Float64:
    """Unit vectors (count, 3), evenly spread over the half sphere of y above 0; every second mirrors the one before."""
    number = np.arange(count // 2) + 0.5
    height, turn = number / (count // 2), np.pi * (1.0 + np.sqrt(5.0)) * number
    flat = np.sqrt(1.0 - height**2)
    half = np.stack([flat * np.cos(turn), height, flat * np.sin(turn)], axis=1)
    return np.stack([half, half * [-1.0, 1.0, 1.0]], axis=1).reshape(-1, 3)


def _cells(u: Float64, v: Float64, cell: float, width: int) -> npt.NDArray[np.int64]:
    """Numbers of the cells of a depth map in which points lie."""
    column, row = (np.clip(np.rint(values / cell).astype(np.int64) + width // 2, 0, width - 1) for values in (u, v))
    return row * width + column


def _surface(points: Float64, faces: npt.NDArray[np.integer[Any]], cell: float) -> Float64:
    """Points (n, 3) on the triangles that are nowhere further apart than a cell."""
    corners = points[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    parts = np.minimum(np.ceil(longest / cell).astype(np.int64), 2 * CELLS)
    samples = []
    for count in np.unique(np.maximum(parts, 1)).tolist():
        triangles = corners[np.maximum(parts, 1) == count]
        # Corners are left out: a vertex does not hide itself, and an edge's end belongs to several triangles.
        first, second = np.meshgrid(np.arange(count), np.arange(count), indexing="ij")
        inside = first + second < count
        a, b = (first[inside] + 1 / 3) / count, (second[inside] + 1 / 3) / count
        shares = np.stack([1 - a - b, a, b], axis=1)
        samples.append(np.einsum("sk,fkc->fsc", shares, triangles).reshape(-1, 3))
    return np.concatenate(samples)
