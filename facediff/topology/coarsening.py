"""Fewer vertices on the same surface: quadric edge collapse, and the sparse maps down to the few and up again."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.topology.projection import project
from facediff.topology.spirals import Indices, Points, checked_faces

Array = npt.NDArray[np.float64]
Pooling = Literal["select", "mean"]

EDGE = 25.0
"""Mean edge length that a mesh is scaled to before it is simplified.

The simplifier compares errors with thresholds in absolute units that grow from pass to pass. At this scale the last
edges of a reduction by four fall some fifteen to thirty passes in, where a threshold is little above the one before
it; in metres all edges would be below the first threshold, and would be collapsed in the order of the file.
"""
AGGRESSION = 7.0
"""Power of the passes' thresholds; the simplifier's own default."""
BLOCK = 64
"""Points at a time in comparisons of all with all."""


@dataclass(frozen=True)
class Operator:
    """A sparse linear map from one set of vertices to another, as plain arrays; no row is without an entry.

    Attributes:
        rows: (N,) row of each entry, ascending.
        columns: (N,) column of each entry.
        weights: (N,) float32, none negative; those of a row sum to one.
        shape: vertices after and before the map.
    """

    rows: Indices
    columns: Indices
    weights: npt.NDArray[np.float32]
    shape: tuple[int, int]

    def apply(self, values: npt.NDArray[np.floating]) -> Array:
        """The map of values (shape[1], ...) in float64."""
        values = np.asarray(values, np.float64)
        scaled = values[self.columns] * self.weights.reshape(-1, *[1] * (values.ndim - 1)).astype(np.float64)
        mapped: Array = np.add.reduceat(scaled, np.searchsorted(self.rows, np.arange(self.shape[0])), axis=0)
        return mapped


@dataclass(frozen=True)
class Coarse:
    """A mesh with fewer vertices, and what links it to the one that it was made from.

    Attributes:
        template: (M, 3) positions: those of the chosen vertices, or the clusters' means.
        faces: (G, 3) vertex indices; no face names a vertex twice and no two faces have the same vertices.
        clusters: (V,) which coarse vertex each vertex became part of.
        down: from the V vertices to the M coarse ones.
        up: from the M coarse vertices to the V ones.
    """

    template: Array
    faces: Indices
    clusters: Indices
    down: Operator
    up: Operator


def coarsen(template: Points, faces: npt.NDArray[np.integer], n_vertices: int, pooling: Pooling = "select") -> Coarse:
    """Reduce a mesh to exactly ``n_vertices`` vertices.

    Edges are collapsed by Garland and Heckbert's quadric error ("Surface simplification using quadric error metrics",
    SIGGRAPH 1997), as Ranjan et al. do for faces ("Generating 3D faces using convolutional mesh autoencoders", ECCV
    2018). The compiled simplifier moves vertices; of its work only the collapses are used. They group the vertices
    into clusters, of which each gives one coarse vertex: the vertex nearest to the cluster's mean (``select``: a row
    of ``down`` has one entry, 1) or the mean (``mean``). A vertex without faces joins the vertex with faces nearest to
    it. Where the simplifier stops too early (it takes no edge that would fold the surface), the shortest edges follow.

    ``up`` writes each vertex as a point of the coarse face nearest to it, among those around its cluster.

    Args:
        template: (V, 3) positions in any unit.
        faces: (F, 3) vertex indices.
        n_vertices: vertices to keep, 1 to V.
        pooling: what a coarse vertex takes from its cluster.

    Raises:
        FaceDiffError: if the template is not (V, 3) or not finite, if faces do not fit it, or if ``n_vertices`` is not
            between 1 and V.
        MissingExtraError: if the simplifier is not installed.
    """
    points = checked_template(template)
    faces = checked_faces(faces, len(points))
    if not 1 <= n_vertices <= len(points):
        raise FaceDiffError(f"coarsen: {n_vertices} vertices asked for; expected 1 to {len(points)}")
    labels = _clusters(points, faces, n_vertices)
    chosen = _nearest_to_mean(points, labels)
    # Coarse vertices are numbered as the chosen ones are.
    order = np.argsort(chosen)
    rank = np.empty_like(order)
    rank[order] = np.arange(n_vertices)
    clusters, chosen = rank[labels], chosen[order]
    down = _selection(chosen, len(points)) if pooling == "select" else _means(clusters, n_vertices)
    coarse = down.apply(points)
    coarse_faces = _coarse_faces(clusters[faces])
    corners, weights = project(points, coarse, coarse_faces, clusters)
    return Coarse(coarse, coarse_faces, clusters, down, _from_corners(corners, weights, n_vertices))


def checked_template(template: Points) -> Array:
    """Positions as float64.

    Raises:
        FaceDiffError: if they are not (V, 3) with at least one vertex, or not finite.
    """
    points = np.asarray(template, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points):
        raise FaceDiffError(f"template: shape {points.shape}; expected (V, 3) with at least one vertex")
    if not np.isfinite(points).all():
        raise FaceDiffError("template: holds values that are not finite; expected a position for every vertex")
    return points


def _clusters(points: Array, faces: Indices, n_vertices: int) -> Indices:
    """(V,) numbers 0 … n_vertices - 1 of the cluster of every vertex."""
    roots = np.arange(len(points))
    spare = len(points) - n_vertices
    used = np.unique(faces)
    if len(used) and spare:
        loose = np.setdiff1d(roots, used)
        near, distance = _nearest(points[loose], points[used])
        loose, near = (part[np.argsort(distance, kind="stable")][:spare] for part in (loose, near))
        pairs = _collapses(points[used], np.searchsorted(used, faces), max(len(used) - spare + len(loose), 1))
        kept, gone = used[pairs[: spare - len(loose)].T]
        # The last collapse first: by then it is known where the vertex that stays ends up.
        for stays, goes in zip(kept[::-1].tolist(), gone[::-1].tolist(), strict=True):
            roots[goes] = roots[stays]
        roots[loose] = roots[used[near]]
    labels = np.unique(roots, return_inverse=True)[1]
    while labels.max() >= n_vertices:
        labels = _merged(points, faces, labels, n_vertices)
    return labels


def _collapses(points: Array, faces: Indices, n_vertices: int) -> Indices:
    """Collapses (N, 2) in their order: the vertex that stays and the one that goes; enough of them, if all goes well.

    Raises:
        MissingExtraError: if the simplifier is not installed.
    """
    try:
        import fast_simplification
    except ImportError as error:
        raise MissingExtraError("fast-simplification", "mesh", "down-sampling a mesh") from error
    corners = points[faces]
    edge = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).mean()
    scaled = (points - points.mean(axis=0)) * (EDGE / edge if edge > 0 else 1.0)
    # Two faces go with a vertex inside, one with a vertex at a border, so this is at least as far as needed.
    target = max(len(faces) - 2 * (len(points) - n_vertices) - 2, 0)
    pairs = fast_simplification.simplify(
        scaled, faces.astype(np.int32), target_count=target, agg=AGGRESSION, return_collapses=True
    )[2]
    return np.asarray(pairs, np.int64).reshape(-1, 2)


def _nearest(points: Array, targets: Array) -> tuple[Indices, Array]:
    """Index of and distance to the target (M, 3) nearest to each point (N, 3); of equal ones the first."""
    index, square = np.zeros(len(points), np.int64), np.zeros(len(points))
    for start in range(0, len(points), BLOCK):
        part = slice(start, start + BLOCK)
        away = np.square(points[part, None, :] - targets[None]).sum(axis=-1)
        index[part] = away.argmin(axis=1)
        square[part] = away.min(axis=1)
    return index, np.sqrt(square)


def _merged(points: Array, faces: Indices, labels: Indices, n_vertices: int) -> Indices:
    """Clusters joined in pairs, the nearest first, along edges where there are any; each is joined once at most."""
    count = int(labels.max()) + 1
    centres = _means(labels, count).apply(points)
    joined = labels[faces]
    pairs = np.concatenate([joined[:, :2], joined[:, 1:], joined[:, ::2]])
    pairs = np.unique(np.sort(pairs[pairs[:, 0] != pairs[:, 1]], axis=1), axis=0)
    if not len(pairs):
        pairs = _neighbours(centres)
    lengths = np.linalg.norm(centres[pairs[:, 0]] - centres[pairs[:, 1]], axis=1)
    roots, taken, left = np.arange(count), np.zeros(count, bool), count - n_vertices
    for first, second in pairs[np.argsort(lengths, kind="stable")].tolist():
        if left and not (taken[first] or taken[second]):
            roots[second], left = first, left - 1
            taken[[first, second]] = True
    return np.unique(roots[labels], return_inverse=True)[1]


def _neighbours(centres: Array) -> Indices:
    """Pairs (N, 2) of each point and the one nearest to it."""
    pairs = []
    for start in range(0, len(centres), BLOCK):
        rows = np.arange(start, min(start + BLOCK, len(centres)))
        away = np.square(centres[rows, None, :] - centres[None]).sum(axis=-1)
        away[np.arange(len(rows)), rows] = np.inf
        pairs.append(np.stack([rows, away.argmin(axis=1)], axis=1))
    return np.unique(np.sort(np.concatenate(pairs), axis=1), axis=0)


def _nearest_to_mean(points: Array, labels: Indices) -> Indices:
    """The vertex of each cluster that is nearest to the cluster's mean; of equal ones the first."""
    centres = _means(labels, int(labels.max()) + 1).apply(points)
    square = np.square(points - centres[labels]).sum(axis=1)
    order = np.lexsort((np.arange(len(points)), square, labels))
    chosen: Indices = order[np.searchsorted(labels[order], np.arange(len(centres)))]
    return chosen


def _selection(chosen: Indices, n_vertices: int) -> Operator:
    rows = np.arange(len(chosen))
    return Operator(rows, chosen, np.ones(len(chosen), np.float32), (len(chosen), n_vertices))


def _means(clusters: Indices, count: int) -> Operator:
    order = np.argsort(clusters, kind="stable")
    weights = (1.0 / np.bincount(clusters, minlength=count))[clusters[order]]
    return Operator(clusters[order], order, weights.astype(np.float32), (count, len(clusters)))


def _from_corners(corners: Indices, weights: Array, count: int) -> Operator:
    """Rows of three corners (V, 3) and their weights, without the entries that are zero."""
    rows, places = np.nonzero(weights > 0)
    return Operator(rows, corners[rows, places], weights[rows, places].astype(np.float32), (len(corners), count))


def _coarse_faces(faces: Indices) -> Indices:
    """Faces without those that lost a corner, and of those with the same corners the first."""
    faces = checked_faces(faces, int(faces.max(initial=-1)) + 1)
    first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1]
    return faces[np.sort(first)]
