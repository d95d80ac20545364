"""A mesh, the same mesh with fewer and fewer vertices, and the maps from each to the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import needs_extra
from facediff.mesh.spirals import checked_faces, spirals
from facediff.utils.numerics import Array, Floats, Indices, Integers

Pooling = Literal["select", "mean"]


@dataclass(frozen=True)
class Operator:
    """A sparse linear map from one set of vertices to another, as plain arrays; no row is without an entry."""

    rows: Indices  # (N,) row of each entry, ascending
    columns: Indices  # (N,) column of each entry
    weights: npt.NDArray[np.float32]  # (N,) float32, none negative; those of a row sum to one
    shape: tuple[int, int]  # vertices after and before the map

    def apply(self, values: Floats) -> Array:
        """The map of values (shape[1], ...) in float64."""
        values = np.asarray(values, np.float64)
        scaled = values[self.columns] * self.weights.reshape(-1, *[1] * (values.ndim - 1)).astype(np.float64)
        return np.asarray(np.add.reduceat(scaled, np.searchsorted(self.rows, np.arange(self.shape[0])), axis=0))


@dataclass(frozen=True)
class MeshLevel:
    """One resolution of a mesh."""

    n_vertices: int
    faces: Indices  # (F, 3)
    spirals: Indices  # (n_vertices, length) every vertex and those around it
    down: Operator | None  # map to the next, coarser level; None at the coarsest


@dataclass(frozen=True)
class MeshHierarchy:
    """A mesh at several resolutions, finest first: one more than the number of down-samplings."""

    levels: tuple[MeshLevel, ...]


def mesh_hierarchy(
    template: Floats,
    faces: Integers,
    levels: int = 3,
    factor: int = 4,
    spiral_length: int = 12,
    dilation: int = 1,
    pooling: Pooling = "select",
) -> MeshHierarchy:
    """A mesh and ``levels`` coarser ones, each with a ``factor``-th of the vertices (rounded up) of the one before.

    Numbers of vertices depend on V, ``factor`` and ``levels`` alone.

    Args:
        template: (V, 3) positions in any unit; used in float32.
        faces: (F, 3) vertex indices.
        levels: down-samplings.
        factor: vertices of a level to one of the next.
        spiral_length: vertices of a spiral, its centre included.
        dilation: distance along the spiral between two of them.
        pooling: whether a coarse vertex is one vertex of its cluster or the cluster's mean.
    """
    points, inner = np.asarray(np.asarray(template, np.float32), np.float64), checked_faces(faces, len(template))
    mesh_levels = []
    for level in range(levels + 1):
        table = spirals(inner, len(points), spiral_length, dilation, points)
        if level == levels:
            mesh_levels.append(MeshLevel(len(points), inner, table, None))
            break
        coarse = coarsen(points, inner, -(-len(points) // factor), pooling)
        mesh_levels.append(MeshLevel(len(points), inner, table, coarse.down))
        points, inner = coarse.template, coarse.faces
    return MeshHierarchy(tuple(mesh_levels))


# One step down: fewer vertices on the same surface by quadric edge collapse.

EDGE = 25.0
"""Mean edge length that a mesh is scaled to before it is simplified.

The simplifier compares errors with thresholds in absolute units that grow from pass to pass. At this scale the last
edges of a reduction by four fall some fifteen to thirty passes in, where a threshold is little above the one before
it; in metres all edges would be below the first threshold, and would be collapsed in the order of the file.
"""
AGGRESSION = 7.0  # Power of the passes' thresholds; the simplifier's own default


@dataclass(frozen=True)
class Coarse:
    """A mesh with fewer vertices, and its relation to the one that it was made from."""

    template: Array  # (M, 3) positions of the representative vertices, or the clusters' means
    faces: Indices  # (G, 3) vertex indices; no face names a vertex twice and no two faces have the same vertices
    clusters: Indices  # (V,) which coarse vertex each vertex became part of
    down: Operator  # from the V vertices to the M coarse ones


def coarsen(template: Floats, faces: Integers, n_vertices: int, pooling: Pooling = "select") -> Coarse:
    """Reduce a mesh (V, 3), (F, 3) in any unit to exactly ``n_vertices`` vertices.

    Edges are collapsed by Garland and Heckbert's quadric error ("Surface simplification using quadric error metrics",
    SIGGRAPH 1997), as Ranjan et al. do for faces ("Generating 3D faces using convolutional mesh autoencoders", ECCV
    2018). The compiled simplifier moves vertices; of its work only the collapses are used. They group the vertices
    into clusters, of which each gives one coarse vertex: the vertex nearest to the cluster's mean (``select``: a row
    of ``down`` has one entry, 1) or the mean (``mean``). A vertex without faces joins the vertex with faces nearest to
    it. Where the simplifier stops too early (it takes no edge that would fold the surface), the shortest edges follow.
    """
    points = np.asarray(template, np.float64)
    faces = checked_faces(faces, len(points))
    labels = _clusters(points, faces, n_vertices)
    # The vertex nearest to the mean stands for its cluster: the simplifier's own positions lie off the surface.
    square = np.square(points - _means(labels, n_vertices).apply(points)[labels]).sum(axis=1)
    # Ties go to the smaller number, so that a hierarchy depends on the mesh alone and a checkpoint finds it again.
    order = np.lexsort((np.arange(len(points)), square, labels))
    representatives = order[np.searchsorted(labels[order], np.arange(n_vertices))]
    # Coarse vertices are numbered in the order of their representatives.
    clusters, representatives = np.argsort(np.argsort(representatives))[labels], np.sort(representatives)
    if pooling == "select":
        down = Operator(
            np.arange(n_vertices), representatives, np.ones(n_vertices, np.float32), (n_vertices, len(points))
        )
    else:
        down = _means(clusters, n_vertices)
    coarse = down.apply(points)
    # Faces without those that lost a corner, and of those with the same corners the first.
    coarse_faces = checked_faces(clusters[faces], n_vertices)
    coarse_faces = coarse_faces[np.sort(np.unique(np.sort(coarse_faces, axis=1), axis=0, return_index=True)[1])]
    return Coarse(coarse, coarse_faces, clusters, down)


def _means(clusters: Indices, count: int) -> Operator:
    order = np.argsort(clusters, kind="stable")
    weights = (1.0 / np.bincount(clusters, minlength=count))[clusters[order]]
    return Operator(clusters[order], order, weights.astype(np.float32), (count, len(clusters)))


def _clusters(points: Array, faces: Indices, n_vertices: int) -> Indices:
    """(V,) numbers 0 … n_vertices - 1 of the cluster of every vertex."""
    roots = np.arange(len(points))
    spare = len(points) - n_vertices
    in_faces = np.unique(faces)
    if len(in_faces) and spare:
        # Vertices without faces never collapse: they are merged first, the nearest to the surface before the others,
        # and the simplifier makes up for the rest.
        loose = np.setdiff1d(roots, in_faces)
        near, distance = _nearest(points[loose], points[in_faces])
        loose, near = (part[np.argsort(distance, kind="stable")][:spare] for part in (loose, near))
        count = max(len(in_faces) - spare + len(loose), 1)
        pairs = in_faces[_collapses(points[in_faces], np.searchsorted(in_faces, faces), count)[: spare - len(loose)]]
        # The last collapse first: by then it is known where the vertex that stays ends up.
        for stays, goes in pairs[::-1].tolist():
            roots[goes] = roots[stays]
        roots[loose] = roots[in_faces[near]]
    labels = np.unique(roots, return_inverse=True)[1]
    # The decoder's layers have fixed sizes: a level must have exactly so many vertices.
    while labels.max() >= n_vertices:
        labels = _merged(points, faces, labels, n_vertices)
    return labels


def _nearest(points: Array, targets: Array) -> tuple[Indices, Array]:
    """Index of and distance to the target (M, 3) nearest to each point (N, 3); of equal ones the first."""
    from scipy.spatial import cKDTree

    tree = cKDTree(targets)
    distance = tree.query(points)[0]
    # A tree returns any of several equally near targets, as where texture seams double a vertex.
    alike = tree.query_ball_point(points, distance * (1 + 1e-12))
    return np.array([min(indices) for indices in alike], np.int64), distance


def _collapses(points: Array, faces: Indices, n_vertices: int) -> Indices:
    """Collapses (N, 2) in their order: the vertex that stays and the one that goes; usually enough of them."""
    with needs_extra("fast-simplification", "mesh", "down-sampling a mesh"):
        import fast_simplification
    corners = points[faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).mean()
    scaled = (points - points.mean(axis=0)) * (EDGE / edge if edge > 0 else 1.0)
    # Two faces go with a vertex inside, one with a vertex at a border, so this is at least as far as needed.
    target = max(len(faces) - 2 * (len(points) - n_vertices) - 2, 0)
    pairs = fast_simplification.simplify(
        scaled, faces.astype(np.int32), target_count=target, agg=AGGRESSION, return_collapses=True
    )[2]
    return np.asarray(pairs, np.int64).reshape(-1, 2)


def _merged(points: Array, faces: Indices, labels: Indices, n_vertices: int) -> Indices:
    """Clusters joined in pairs, the nearest first, along edges where there are any; each is joined once at most."""
    from scipy.spatial import cKDTree

    count = int(labels.max()) + 1
    centres = _means(labels, count).apply(points)
    joined = labels[faces]
    pairs = np.concatenate([joined[:, :2], joined[:, 1:], joined[:, ::2]])
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    if not len(pairs):  # no edges are left: each cluster and the one nearest to it
        every, near = np.arange(count), cKDTree(centres).query(centres, k=2)[1]
        # Where several clusters lie in one place, the first result need not be the cluster itself.
        pairs = np.stack([every, np.where(near[:, 0] == every, near[:, 1], near[:, 0])], axis=1)
    pairs = np.unique(np.sort(pairs, axis=1), axis=0)
    lengths = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    roots, merged, left = np.arange(count), np.zeros(count, bool), count - n_vertices
    for first, second in pairs[np.argsort(lengths, kind="stable")].tolist():
        if left and not (merged[first] or merged[second]):
            roots[second], left = first, left - 1
            merged[[first, second]] = True
    return np.unique(roots[labels], return_inverse=True)[1]
