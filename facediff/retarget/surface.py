"""The nearest points of a surface, among the sheets that face the same way."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt
import torch

from facediff.topology import face_size

# The exact nearest point of a triangle is the mesh hierarchy's own, and not written a second time.
from facediff.topology.projection import closest_on_triangles

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

SLACK = 0.04
"""A sheet that faces the same way is taken before one that faces away and is nearer by this share of the face's size:
lips that touch are two sheets in one place."""
FACING, AWAY = 0.3, -0.3
"""Cosines between normals from which on two sheets face the same way, and up to which they face away."""
TIE = 1e-6
"""Of two places that are equally near but for this share of a triangle, the one that faces the same way is taken."""
CHUNK_NUMBERS = 4_000_000
"""Distances and candidate triangles that are held at a time."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh to look for nearest points on.

    Attributes:
        vertices: (V, 3).
        faces: (F, 3).
    """

    vertices: Array
    faces: Indices

    @cached_property
    def normals(self) -> Array:
        """(V, 3) unit normals of the vertices; zero where no triangle touches."""
        return vertex_normals(self.vertices, self.faces)

    @cached_property
    def size(self) -> float:
        """Root-mean-square distance of the vertices that triangles touch from their mean."""
        return face_size(self.vertices[np.unique(self.faces)])


@dataclass(frozen=True, eq=False)
class Nearest:
    """Points of a surface.

    Attributes:
        corners: (N, 3) vertices of the triangle of each.
        weights: (N, 3) barycentric weights of its corners, none negative, which sum to one.
        points: (N, 3) where it lies.
        normals: (N, 3) unit normals there.
        distances: (N,) how far it is.
        cosines: (N,) between the normals there and here.
    """

    corners: Indices
    weights: Array
    points: Array
    normals: Array
    distances: Array
    cosines: Array


def vertex_normals(vertices: Array, faces: Indices) -> Array:
    """Unit normals (V, 3), each the mean of its triangles' weighted by the angles at the vertex.

    Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", Journal of Graphics Tools 1998: unlike
    weights by area, these do not depend on how a flat piece is cut into triangles.
    """
    corners = vertices[faces]
    normal = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    total = np.zeros_like(vertices)
    for corner in range(3):
        ahead = _unit(corners[:, (corner + 1) % 3] - corners[:, corner])
        behind = _unit(corners[:, (corner + 2) % 3] - corners[:, corner])
        angle = np.arccos(np.clip((ahead * behind).sum(axis=1), -1.0, 1.0))
        np.add.at(total, faces[:, corner], angle[:, None] * normal)
    return _unit(total)


def nearest(surface: Surface, points: Array, normals: Array, size: float | None = None) -> Nearest:
    """The nearest point of a surface to each point (N, 3), with its normal's say about the sheet.

    Every triangle that could hold it is looked at, so that the point found is the nearest of all of its sheet.

    Args:
        surface: where to look.
        points: from where.
        normals: (N, 3) unit normals there; zero where there is none.
        size: of the whole that the surface may be a part of; its own if None. At 0, the nearest point counts, however
            it faces.
    """
    slack = SLACK * (surface.size if size is None else size)
    search = _Search(surface)
    faces, weights, cosines = search.best(points, normals, 0.0)
    # What faces the same way and is nearest needs no other candidates.
    doubtful = np.flatnonzero(cosines < FACING)
    if slack and len(doubtful):
        faces[doubtful], weights[doubtful], cosines[doubtful] = search.best(points[doubtful], normals[doubtful], slack)
    corners = surface.faces[faces]
    where = np.einsum("nc,ncd->nd", weights, surface.vertices[corners])
    there = _unit(np.einsum("nc,ncd->nd", weights, surface.normals[corners]))
    return Nearest(corners, weights, where, there, np.linalg.norm(points - where, axis=1), cosines)


class _Search:
    """Candidates by the balls around triangles, and the best of them.

    Attributes:
        surface: where to look.
        triangles: (F, 3, 3) corners.
        centres: (F, 3) of the balls.
        radii: (F,) of the balls.
    """

    def __init__(self, surface: Surface) -> None:
        self.surface = surface
        self.triangles = surface.vertices[surface.faces]
        self.centres = self.triangles.mean(axis=1)
        self.radii = np.linalg.norm(self.triangles - self.centres[:, None], axis=2).max(axis=1)

    def best(self, points: Array, normals: Array, slack: float) -> tuple[Indices, Array, Array]:
        """Face (N,), weights (N, 3) and cosine (N,) of the best place for each point.

        Args:
            points: (N, 3).
            normals: (N, 3).
            slack: how much nearer a sheet that faces away must be to be taken.
        """
        faces, weights, cosines = np.empty(len(points), np.int64), np.empty((len(points), 3)), np.empty(len(points))
        step = max(1, CHUNK_NUMBERS // len(self.centres))
        rounding = 1e-6 * float(self.radii.max() + np.abs(self.centres).max())
        for first in range(0, len(points), step):
            some = slice(first, first + step)
            away = torch.cdist(torch.from_numpy(points[some]), torch.from_numpy(self.centres)).numpy()
            # A centre is on the surface, so the surface is no further away; a triangle is no nearer than its ball.
            limit = away.min(axis=1, keepdims=True) + slack + rounding
            point, face = np.nonzero(away - self.radii <= limit)
            pairs = point.astype(np.int64, copy=False), face.astype(np.int64, copy=False)
            faces[some], weights[some], cosines[some] = self._best_of(points[some], normals[some], pairs, slack)
        return faces, weights, cosines

    def _best_of(
        self, points: Array, normals: Array, pairs: tuple[Indices, Indices], slack: float
    ) -> tuple[Indices, Array, Array]:
        """The best of candidates (point, face), which are sorted by point."""
        point, face = pairs
        weights, square = np.empty((len(point), 3)), np.empty(len(point))
        for first in range(0, len(point), CHUNK_NUMBERS // 16):
            some = slice(first, first + CHUNK_NUMBERS // 16)
            weights[some], square[some] = closest_on_triangles(points[point[some]], self.triangles[face[some]])
        there = _unit(np.einsum("nc,ncd->nd", weights, self.surface.normals[self.surface.faces[face]]))
        cosine = np.einsum("nd,nd->n", there, normals[point])
        wrong = np.clip((FACING - cosine) / (FACING - AWAY), 0.0, 1.0)
        cost = np.sqrt(square) + slack * wrong + TIE * self.radii[face] * (1.0 - cosine)
        order = np.lexsort((face, cost, point))
        _, starts = np.unique(point[order], return_index=True)
        best = order[starts]
        return face[best], weights[best], cosine[best]


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    unit: Array = np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0)
    return unit
