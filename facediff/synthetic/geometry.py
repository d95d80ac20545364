"""Geometry of the puppet's head: curves and hills, a triangulation, and meshes mirrored from one half."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Faces = NDArray[np.int64]


@dataclass(frozen=True)
class HeadMesh:
    """A triangle mesh with named vertices."""

    vertices: Array  # Positions, shape (V, 3)
    faces: Faces  # Vertex indices, counter-clockwise seen from outside, shape (F, 3)
    colours: NDArray[np.uint8]  # Red, green, blue of every vertex in 0..255, shape (V, 3), uint8
    mirror: NDArray[np.int64]  # Index of the vertex on the other side, shape (V,); its own on the midline
    # Named lists of vertices of the left half (x >= 0), in the order in which they were made
    groups: dict[str, NDArray[np.int64]]

    def both(self, *names: str) -> NDArray[np.int64]:
        """Sorted vertices of the named groups on both sides."""
        left = np.concatenate([self.groups[name] for name in names])
        return np.unique(np.concatenate([left, self.mirror[left]]))


@dataclass
class HalfMesh:
    """Left half of a mesh (x >= 0) under construction; points with x = 0 are shared by both halves."""

    points: list[Array] = field(default_factory=list)
    colours: list[Array] = field(default_factory=list)
    faces: list[Faces] = field(default_factory=list)
    groups: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    count: int = 0

    def add(self, name: str, points: Array, colour: tuple[int, int, int]) -> NDArray[np.int64]:
        """Add points of one colour under a name and return their indices."""
        index = np.arange(self.count, self.count + len(points))
        self.points.append(np.asarray(points, dtype=np.float64))
        self.colours.append(np.tile(np.array(colour, dtype=np.float64), (len(points), 1)))
        self.groups[name] = index
        self.count += len(points)
        return index

    def strip(self, outer: NDArray[np.int64], inner: NDArray[np.int64], closed: bool = False) -> None:
        """Join two rows of equal length; ``outer`` runs clockwise round ``inner`` seen from outside."""
        a, b = outer, inner
        if closed:
            a, b = np.append(a, a[0]), np.append(b, b[0])
        self.faces.append(np.stack([a[:-1], b[:-1], b[1:]], axis=1))
        self.faces.append(np.stack([a[:-1], b[1:], a[1:]], axis=1))

    def fan(self, ring: NDArray[np.int64], centre: int) -> None:
        """Join a closed clockwise ring to a point."""
        self.faces.append(np.stack([ring, np.full_like(ring, centre), np.roll(ring, -1)], axis=1))

    def mirrored(self) -> HeadMesh:
        """Both halves as one mesh: the left half's points, then the mirror images of all off the midline."""
        points, colours = np.concatenate(self.points), np.concatenate(self.colours)
        faces = np.concatenate(self.faces)
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        off = np.flatnonzero(points[:, 0] != 0.0)
        mirror = np.arange(self.count)
        mirror[off] = self.count + np.arange(len(off))
        other = mirror[faces][:, ::-1]
        double = np.concatenate([points, points[off] * np.array([-1.0, 1.0, 1.0])])
        return HeadMesh(
            vertices=double,
            faces=np.concatenate([faces, other]),
            colours=np.clip(np.rint(np.concatenate([colours, colours[off]])), 0, 255).astype(np.uint8),
            mirror=np.concatenate([mirror, off]),
            groups=dict(self.groups),
        )


def through(knots: ArrayLike, values: ArrayLike, at: ArrayLike) -> Array:
    """Interpolate with cubic Hermite pieces whose slopes never overshoot (Fritsch and Carlson, 1980).

    Knots (n,) rise; ``at`` has any shape, and outside the knots the end values hold.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    places = np.clip(np.asarray(at, dtype=np.float64), x[0], x[-1])
    step = np.diff(x)
    slope = np.diff(y) / step
    tangent = np.zeros_like(y)
    before, after = slope[:-1], slope[1:]
    weight_before, weight_after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    same_way = before * after > 0
    safe_before, safe_after = np.where(same_way, before, 1.0), np.where(same_way, after, 1.0)
    harmonic = (weight_before + weight_after) / (weight_before / safe_before + weight_after / safe_after)
    tangent[1:-1] = np.where(same_way, harmonic, 0.0)
    tangent[0], tangent[-1] = slope[0], slope[-1]
    piece = np.clip(np.searchsorted(x, places, side="right") - 1, 0, x.size - 2)
    t = (places - x[piece]) / step[piece]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * y[piece]
        + t * (1 - t) ** 2 * step[piece] * tangent[piece]
        + t**2 * (3 - 2 * t) * y[piece + 1]
        + t**2 * (t - 1) * step[piece] * tangent[piece + 1]
    )


def spline(knots: ArrayLike, values: ArrayLike) -> Callable[[ArrayLike], Array]:
    """A natural cubic spline, which unlike :func:`through` has continuous curvature.

    Knots (n,) rise; values (n, K). The function takes places of any shape and gives (..., K); outside the knots the end
    values hold.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    step = np.diff(x)
    slope = np.diff(y, axis=0) / step[:, None]
    # The second derivatives at the knots: continuity of the first ones, and 0 at both ends.
    system, right = np.eye(x.size), np.zeros_like(y)
    for knot in range(1, x.size - 1):
        system[knot, knot - 1 : knot + 2] = step[knot - 1], 2 * (step[knot - 1] + step[knot]), step[knot]
        right[knot] = 6 * (slope[knot] - slope[knot - 1])
    bend = np.linalg.solve(system, right)

    def at(places: ArrayLike) -> Array:
        inside = np.clip(np.asarray(places, dtype=np.float64), x[0], x[-1])
        piece = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, x.size - 2)
        width, before = step[piece][..., None], (inside - x[piece])[..., None]
        after = width - before
        return np.asarray(
            (bend[piece] * after**3 + bend[piece + 1] * before**3) / (6 * width)
            + (y[piece] / width - bend[piece] * width / 6) * after
            + (y[piece + 1] / width - bend[piece + 1] * width / 6) * before
        )

    return at


def rise(values: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Go from 0 at ``low`` to 1 at ``high`` with flat ends (smoothstep); ``low`` may lie above ``high``."""
    start, end = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    t = np.clip((np.asarray(values, dtype=np.float64) - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def bump(x: ArrayLike, y: ArrayLike, centre: tuple[float, float], width: tuple[float, float]) -> Array:
    """Gaussian hill of height 1 over the plane, with standard deviations ``width`` along x and y."""
    across = (np.asarray(x, dtype=np.float64) - centre[0]) / width[0]
    along = (np.asarray(y, dtype=np.float64) - centre[1]) / width[1]
    return np.asarray(np.exp(-0.5 * (across**2 + along**2)))


# Delaunay triangulation of points in the plane.

# Coordinates are rounded to this fraction of a millimetre and the tests are done in whole numbers: with a
# domain of less than 2**14 such steps every determinant fits into 64 bits, so no rounding can flip an edge.
_STEPS_PER_MM = 25
_LARGEST = 2**14


def delaunay(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Triangulate points (n, 2) in mm, all different, by inserting them one by one (Bowyer and Watson, 1981).

    The triangles (m, 3) are counter-clockwise; together they fill the convex hull up to slivers along it.
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
