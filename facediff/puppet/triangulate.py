"""Delaunay triangulation of points in the plane, exact and so the same on every machine."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Coordinates are rounded to this fraction of a millimetre and the tests are done in whole numbers: with a
# domain of less than 2**14 such steps every determinant fits into 64 bits, so no rounding can flip an edge.
_STEPS_PER_MM = 25
_LARGEST = 2**14


def delaunay(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangulate points by inserting them one by one (Bowyer and Watson, 1981).

    Args:
        points: Coordinates in mm, shape (n, 2), all different.

    Returns:
        Triangles as indices of points, counter-clockwise, shape (m, 3); together they fill the points' convex
        hull up to slivers along it.

    Raises:
        ValueError: If the points spread over more than the exact arithmetic can hold.
    """
    whole = np.rint((points - points.min(axis=0)) * _STEPS_PER_MM).astype(np.int64)
    extent = int(whole.max())
    if extent > _LARGEST // 2:
        raise ValueError(f"points spread over {extent} steps, more than {_LARGEST // 2}")
    margin = extent // 4
    low, high = -margin, extent + margin
    corners = np.array([[low, low], [high, low], [high, high], [low, high]], dtype=np.int64)
    count = len(points)
    places = np.concatenate([whole, corners])
    triangles = np.array([[count, count + 1, count + 2], [count, count + 2, count + 3]])
    for index in range(count):
        triangles = _insert(places, triangles, index)
    return triangles[(triangles < count).all(axis=1)]


def _insert(places: NDArray[np.int64], triangles: NDArray[np.int64], index: int) -> NDArray[np.int64]:
    """Remove the triangles whose circumcircle holds the point and fan their outline round it."""
    corner = places[triangles] - places[index]
    square = (corner**2).sum(axis=2)
    (ax, ay), (bx, by), (cx, cy) = (corner[:, k].T for k in range(3))
    determinant = (
        square[:, 0] * (bx * cy - cx * by) - square[:, 1] * (ax * cy - cx * ay) + square[:, 2] * (ax * by - bx * ay)
    )
    inside = determinant > 0
    hole = triangles[inside]
    edges = np.concatenate([hole[:, [0, 1]], hole[:, [1, 2]], hole[:, [2, 0]]])
    there = {(int(a), int(b)) for a, b in edges}
    outline = [(int(a), int(b)) for a, b in edges if (int(b), int(a)) not in there]
    fan = np.array([(a, b, index) for a, b in outline], dtype=np.int64).reshape(-1, 3)
    first, second = places[fan[:, 1]] - places[fan[:, 0]], places[fan[:, 2]] - places[fan[:, 0]]
    area = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
    return np.concatenate([triangles[~inside], fan[area > 0]])
