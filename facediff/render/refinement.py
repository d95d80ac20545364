"""Triangles made finer where they are large in the picture, so that light per vertex looks like light per pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.render.meshes import Faces

Float32 = npt.NDArray[np.float32]
Pairs = npt.NDArray[np.int32]

SHARP = 0.15
"""Difference of two unit normals, 9 degrees, over which a highlight may come and go."""
MOST_ROUNDS = 6
"""Each round halves an edge: 64 pieces of an edge are enough for any mesh that fits into a picture."""


class Refinement:
    """Splits long edges in the middle, again and again; the surface stays where it is.

    Light is computed per vertex and interpolated over triangles, which shows facets where triangles are large and none
    where they are small. Edges to split are chosen once, on the template (V, 3): those above ``longest``, or half of it
    where unit normals (V, 3) differ by `SHARP` along them, and above ``shortest``. An edge belongs to all its
    triangles, so that no gap opens between them, and frames differ by motion only.

    Example:
        >>> finer = Refinement(np.array([[0, 1, 2]]), np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), longest=1.2)
        >>> finer.faces.tolist()  # only the edge from 1 to 2 is longer than 1.2; vertex 3 lies in its middle
        [[1, 3, 0], [3, 2, 0]]
        >>> finer.values(np.float32([[0, 0], [2, 4], [4, 8]]))[3].tolist()
        [3.0, 6.0]
    """

    def __init__(
        self,
        faces: npt.NDArray[np.integer],
        template: npt.NDArray[np.floating],
        longest: float,
        normals: npt.NDArray[np.floating] | None = None,
        shortest: float = 0.0,
    ) -> None:
        self._rounds: list[Pairs] = []
        triangles = np.asarray(faces, np.int32)
        flat = np.zeros_like(template) if normals is None else normals
        points = np.concatenate([template, flat], axis=1, dtype=np.float32)
        for _ in range(MOST_ROUNDS):
            triangles, pairs = _split_long_edges(triangles, points, longest, shortest)
            if len(pairs) == 0:
                break
            self._rounds.append(pairs)
            points = _with_middles(points, pairs)
        self.faces: Faces = np.ascontiguousarray(triangles)
        self.n_vertices = len(points)

    def values(self, values: Float32) -> Float32:
        """Values of the vertices (V, channels) and, below them, values of the added vertices."""
        for pairs in self._rounds:
            values = _with_middles(values, pairs)
        return values


def _with_middles(values: Float32, pairs: Pairs) -> Float32:
    middles = values[pairs[:, 0]]
    middles += values[pairs[:, 1]]
    middles *= np.float32(0.5)
    return np.concatenate([values, middles])


def _split_long_edges(faces: Faces, points: Float32, longest: float, shortest: float) -> tuple[Faces, Pairs]:
    """One round, given positions and normals (V, 6).

    Returns:
        The triangles after it, and the pairs of vertices with a new vertex in their middle, in order.
    """
    n_vertices = len(points)
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()  # edge k of a face leads from corner k to k + 1
    keys = np.minimum(starts, ends).astype(np.int64) * n_vertices + np.maximum(starts, ends)
    edges, which = np.unique(keys, return_inverse=True)
    pairs = np.column_stack([edges // n_vertices, edges % n_vertices]).astype(np.int32)
    difference = points[pairs[:, 0]] - points[pairs[:, 1]]
    length, turn = np.linalg.norm(difference[:, :3], axis=1), np.linalg.norm(difference[:, 3:], axis=1)
    too_long = (length * (1 + turn / SHARP) > longest) & (length > shortest)
    numbers = np.where(too_long, n_vertices + np.cumsum(too_long) - 1, -1)
    middles = numbers[which].reshape(faces.shape).astype(np.int32)
    count = (middles >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    for edge in range(3):
        corner, mid = np.roll(faces, -edge, axis=1), np.roll(middles, -edge, axis=1)
        # One long edge: two triangles.
        one = (count == 1) & (mid[:, 0] >= 0)
        (a, b, c), m = corner[one].T, mid[one, 0]
        parts += [np.column_stack([a, m, c]), np.column_stack([m, b, c])]
        # Two: the corner between them is cut off, and the rest is cut along a diagonal.
        two = (count == 2) & (mid[:, 2] < 0)
        (a, b, c), (m, n, _) = corner[two].T, mid[two].T
        parts += [np.column_stack([m, b, n]), np.column_stack([a, m, n]), np.column_stack([a, n, c])]
    (a, b, c), (m, n, o) = faces[count == 3].T, middles[count == 3].T
    parts += [np.column_stack(corners) for corners in ((a, m, o), (m, b, n), (o, n, c), (m, n, o))]
    return np.concatenate(parts).astype(np.int32), pairs[too_long]
