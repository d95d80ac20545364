"""Separate pieces of a mesh (teeth, eyes, skin), and which piece of another mesh each one is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.retarget.surface import Nearest, Surface, nearest
from facediff.topology import face_size

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

MOST = 32
"""As many of the largest pieces are looked at; hair may be thousands."""
ALIKE = 1.5
"""Two pieces differ in size by no more than this factor."""
NEAR = 1.0
"""Partners' centres lie no further apart than this share of the smaller one's size."""
WELD = 1e-6
"""Vertices nearer than this share of the mesh's size are one: seams of textures do not part a mesh."""


@dataclass(frozen=True, eq=False)
class Partners:
    """Where to look for the nearest points of each target vertex.

    Attributes:
        parts: vertices of the target (N,) and the part of the source on which theirs lie; together all vertices.
        size: of the source.
    """

    parts: list[tuple[Indices, Surface]]
    size: float

    def nearest(self, points: Array, normals: Array) -> Nearest:
        """The nearest point of each target vertex (Vt, 3) on its part of the source."""
        count = len(points)
        corners = np.empty((count, 3), np.int64)
        weights, where, facing = (np.empty((count, 3)) for _ in range(3))
        away, cosines = np.empty(count), np.empty(count)
        for some, surface in self.parts:
            found = nearest(surface, points[some], normals[some], self.size)
            corners[some], weights[some], where[some] = found.corners, found.weights, found.points
            facing[some], away[some], cosines[some] = found.normals, found.distances, found.cosines
        return Nearest(corners, weights, where, facing, away, cosines)


def partners(source: Surface, laid: Surface) -> Partners:
    """Pair the pieces of a target that lies on a source with the source's.

    Partners are about as large and lie about in one place; of all ways to pair, the one with the least distances
    counts, so that lower teeth are not taken for upper ones. What has no partner is looked for on all of the source.
    """
    labels = [pieces(surface) for surface in (source, laid)]
    (centres, sizes, kept), (goals, extents, others) = (
        _measured(surface, label) for surface, label in zip((source, laid), labels, strict=True)
    )
    away = np.linalg.norm(goals[:, None] - centres[None], axis=2)
    alike = np.abs(np.log(extents[:, None] / sizes[None])) < np.log(ALIKE)
    limit = NEAR * np.minimum(extents[:, None], sizes[None])
    # A place of its own for every piece that finds no partner: relative to the limit, it costs one.
    cost = np.concatenate([np.where(alike & (away < limit), away / limit, 1e6), np.ones((len(goals),) * 2)], axis=1)
    parts, left = [], np.ones(len(laid.vertices), bool)
    for row, column in enumerate(least_pairing(cost)):
        if column < len(kept):
            some = np.flatnonzero(labels[1] == others[row])
            parts.append((some, Surface(source.vertices, source.faces[labels[0][source.faces[:, 0]] == kept[column]])))
            left[some] = False
    if left.any():
        parts.append((np.flatnonzero(left), source))
    return Partners(parts, source.size)


def least_pairing(cost: Array) -> list[int]:
    """The column of each row, all different, with the least total cost (N, M), N ≤ M.

    Kuhn, "The Hungarian method for the assignment problem", Naval Research Logistics 1955, with shortest augmenting
    paths: rows come in one by one, and each may move those before it.
    """
    rows, columns = cost.shape
    row_price, column_price = np.zeros(rows), np.zeros(columns)
    owner = np.full(columns, -1)
    for new in range(rows):
        least, before = np.full(columns, np.inf), np.full(columns, -1)
        done = np.zeros(columns, bool)
        row, column = new, -1
        while row >= 0:
            reach = (least[column] if column >= 0 else 0.0) + cost[row] - row_price[row] - column_price
            better = ~done & (reach < least)
            least[better], before[better] = reach[better], column
            column = int(np.where(done, np.inf, least).argmin())
            row = int(owner[column])
            done[column] = True
        found = least[column]
        reached = done & (least < found)
        row_price[new] += found
        row_price[owner[reached]] += found - least[reached]
        column_price[reached] -= found - least[reached]
        while column >= 0:
            owner[column] = owner[before[column]] if before[column] >= 0 else new
            column = int(before[column])
    return [int(np.flatnonzero(owner == row)[0]) for row in range(rows)]


def pieces(surface: Surface) -> Indices:
    """A label (V,) for each vertex, equal for those that triangles join or that lie in one place."""
    extent = max(float(np.ptp(surface.vertices, axis=0).max()), np.finfo(float).tiny)
    _, place = np.unique(np.rint(surface.vertices / (WELD * extent)), axis=0, return_inverse=True)
    place = place.reshape(-1)
    faces = place[surface.faces]
    labels = np.arange(place.max() + 1)
    while True:
        least = labels[faces].min(axis=1)
        new = labels.copy()
        for corner in range(3):
            np.minimum.at(new, faces[:, corner], least)
        new = new[new]
        if np.array_equal(new, labels):
            return labels[place]
        labels = new


def _measured(surface: Surface, labels: Indices) -> tuple[Array, Array, Indices]:
    """Centres (P, 3), sizes (P,) and labels (P,) of the largest pieces that triangles make."""
    names, counts = np.unique(labels[surface.faces[:, 0]], return_counts=True)
    names = names[np.argsort(-counts, kind="stable")[:MOST]]
    points = [surface.vertices[np.unique(surface.faces[labels[surface.faces[:, 0]] == name])] for name in names]
    centres = np.stack([part.mean(axis=0) for part in points])
    sizes = np.array([max(face_size(part), np.finfo(float).tiny) for part in points])
    return centres, sizes, names
