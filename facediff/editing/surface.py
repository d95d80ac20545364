"""Surfaces of triangles, and their nearest points among the sheets that face the same way."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from facediff.mesh import face_size
from facediff.mesh.mesh import closest_on_triangles
from facediff.utils.numerics import Array, Indices, Integers

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


SLACK = 0.04
"""A sheet that faces the same way is preferred to one that faces away and is nearer by up to this share of the face's
size: lips that touch are two sheets in one place."""
FACING, AWAY = 0.3, -0.3
"""Cosines between normals from which on two sheets face the same way, and up to which they face away."""
TIE = 1e-6
"""Of two points with distances that differ by less than this share of a triangle, the one that faces the same way
wins."""
CHUNK_NUMBERS = 4_000_000  # Candidate pairs of a point and a triangle that are held in memory at a time, at most


@dataclass(frozen=True, eq=False)
class Surface:
    """A triangle mesh (V, 3), (F, 3) with a search for nearest points."""

    vertices: Array
    faces: Indices

    @cached_property
    def normals(self) -> Array:
        """(V, 3) unit normals, each the mean of its triangles' weighted by the angles at the vertex; zero without any.

        Thürmer and Wüthrich, "Computing vertex normals from polygonal facets", Journal of Graphics Tools 1998: unlike
        weights by area, these do not depend on how a flat piece is cut into triangles.
        """
        from trimesh import Trimesh

        return np.asarray(Trimesh(self.vertices, self.faces, process=False).vertex_normals, np.float64)

    @cached_property
    def size(self) -> float:
        """Size of the part that triangles touch."""
        return face_size(self.vertices[np.unique(self.faces)])

    @cached_property
    def triangles(self) -> Array:
        """(F, 3, 3) corners."""
        return self.vertices[self.faces]

    @cached_property
    def balls(self) -> tuple[Array, Array, list[tuple[Indices, cKDTree]]]:
        """Centres (F, 3) and radii (F,) of balls around the triangles; and trees of those about equally large.

        A tree finds the balls that may hold a nearest point by the largest radius in it, so that a few large triangles
        among many small ones (the back of a head) need a tree of their own.
        """
        from scipy.spatial import cKDTree

        centres = self.triangles.mean(axis=1)
        radii = np.linalg.norm(self.triangles - centres[:, None], axis=2).max(axis=1)
        largest = max(float(radii.max()), np.finfo(float).tiny)
        octave = np.floor(np.log2(np.maximum(radii / largest, 2.0**-10)))
        groups = [np.flatnonzero(octave == one) for one in np.unique(octave)]
        return centres, radii, [(faces, cKDTree(centres[faces])) for faces in groups]


@dataclass(frozen=True, eq=False)
class Nearest:
    """N points of a surface, each the nearest one to a given point."""

    corners: Indices  # (N, 3) vertices of its triangle
    weights: Array  # (N, 3) barycentric weights of the corners, none negative, which sum to one
    points: Array  # (N, 3) where it lies
    normals: Array  # (N, 3) unit normals of the surface there
    distances: Array  # (N,) from the given point
    cosines: Array  # (N,) between the surface's normal and that of the given point


def edges_of(faces: Indices) -> Indices:
    """Edges (E, 2), each once."""
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    return edges[edges[:, 0] != edges[:, 1]]


def components(edges: Indices, count: int) -> Indices:
    """A label (count,) for each vertex, equal for those that edges (E, 2) join."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    joined = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(count, count))
    return np.asarray(connected_components(joined, directed=False)[1], np.int64)


def triangle_normals(points: Array, faces: Integers) -> Array:
    """Normals (F, 3) of triangles, as long as twice their areas."""
    a, b, c = (points[faces[:, corner]] for corner in range(3))
    return np.asarray(np.cross(b - a, c - a))


def nearest(surface: Surface, points: Array, normals: Array, size: float | None = None) -> Nearest:
    """The nearest point of a surface to each point (N, 3), where normals decide between sheets.

    Every triangle that could hold it is looked at, so that the point found is the nearest of all of its sheet. Normals
    (N, 3) are zero where a point has none. The slack between sheets is relative to ``size``, the surface's if None;
    at 0, the nearest point counts with any normal.
    """
    slack = SLACK * (surface.size if size is None else size)
    faces, weights, cosines = _best(surface, points, normals, 0.0)
    # A nearest place that faces the same way stays the best one with slack, which only costs places that do not.
    doubtful = np.flatnonzero(cosines < FACING)
    if slack and len(doubtful):
        faces[doubtful], weights[doubtful], cosines[doubtful] = _best(
            surface, points[doubtful], normals[doubtful], slack
        )
    corners = surface.faces[faces]
    where = np.einsum("nc,ncd->nd", weights, surface.vertices[corners])
    normals_there = _unit(np.einsum("nc,ncd->nd", weights, surface.normals[corners]))
    return Nearest(corners, weights, where, normals_there, np.linalg.norm(points - where, axis=1), cosines)


def _best(surface: Surface, points: Array, normals: Array, slack: float) -> tuple[Indices, Array, Array]:
    """Face (N,), weights (N, 3) and cosine (N,) of the best place; a sheet that faces away must be nearer by slack."""
    faces, weights, cosines = np.empty(len(points), np.int64), np.empty((len(points), 3)), np.empty(len(points))
    step = max(1, CHUNK_NUMBERS // len(surface.faces))
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        point, face = _candidates(surface, points[some], slack)
        shares, square = closest_on_triangles(points[some][point], surface.triangles[face])
        normals_there = _unit(np.einsum("nc,ncd->nd", shares, surface.normals[surface.faces[face]]))
        cosine = np.einsum("nd,nd->n", normals_there, normals[some][point])
        wrong = np.clip((FACING - cosine) / (FACING - AWAY), 0.0, 1.0)
        # The distance decides; a sheet that faces away costs the slack, and between equal distances the normal decides.
        cost = np.sqrt(square) + slack * wrong + TIE * surface.balls[1][face] * (1.0 - cosine)
        order = np.lexsort((face, cost, point))
        best = order[np.unique(point[order], return_index=True)[1]]
        faces[some], weights[some], cosines[some] = face[best], shares[best], cosine[best]
    return faces, weights, cosines


def _candidates(surface: Surface, points: Array, slack: float) -> tuple[Indices, Indices]:
    """Pairs (point, face): all triangles that may hold a place not further away than the nearest one and the slack."""
    centres, radii, trees = surface.balls
    rounding = 1e-6 * float(radii.max() + np.abs(centres).max())
    # A centre is on the surface, so the surface is no further away; a triangle is no nearer than its ball.
    limit = np.min([tree.query(points)[0] for _, tree in trees], axis=0) + slack + rounding
    pairs = []
    for faces, tree in trees:
        near = tree.query_ball_point(points, limit + radii[faces].max())
        point = np.repeat(np.arange(len(points)), [len(some) for some in near])
        face = faces[np.fromiter(itertools.chain.from_iterable(near), np.int64)]
        near_enough = np.linalg.norm(points[point] - centres[face], axis=1) - radii[face] <= limit[point]
        pairs.append((point[near_enough], face[near_enough]))
    point, face = (np.concatenate(part) for part in zip(*pairs, strict=True))
    return point, face


def _unit(vectors: Array) -> Array:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(np.divide(vectors, length, out=np.zeros_like(vectors), where=length > 0))
