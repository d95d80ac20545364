"""Spiral sequences: every vertex and its neighbours in a fixed order, the reach of a spiral convolution."""

from __future__ import annotations

import numpy as np

from facediff.errors import FaceDiffError
from facediff.utils.numerics import Floats, Indices, Integers


def spirals(
    faces: Integers, n_vertices: int, length: int, dilation: int = 1, template: Floats | None = None
) -> Indices:
    """Every vertex followed by the vertices on the rings around it, ring by ring.

    Gong, Chen, Bronstein and Zafeiriou, "SpiralNet++: A Fast and Highly Efficient Mesh Convolution Operator", ICCV
    Workshops 2019, section 3.1: ring k + 1 holds the neighbours of ring k that are on no ring before it. The first
    ring begins at the neighbour with the smallest index, or at the first one along the border where the fan of faces
    is open. All rings run counter-clockwise as seen from the side on which the faces are. With a dilation, every
    ``dilation``-th vertex of a spiral of ``length * dilation`` vertices is taken.

    Where the rings end first (a small part of the mesh, a vertex without faces), the nearest vertices that are not in
    the spiral follow. No vertex comes twice while there are others left; after that, the vertex itself fills the rest.

    Args:
        faces: (F, 3) vertex indices.
        n_vertices: V.
        length: entries of a spiral, the vertex itself included.
        dilation: distance along the spiral between two entries.
        template: (V, 3) positions, needed only where rings end too early.

    Returns:
        (V, length) vertex indices; column 0 is the vertex itself.
    """
    faces = checked_faces(faces, n_vertices)
    rings = ordered_rings(faces, n_vertices)
    full_length = min(length * dilation, n_vertices)
    table = np.empty((n_vertices, length), np.int64)
    for vertex in range(n_vertices):
        spiral = _spiral(vertex, rings, full_length)
        if len(spiral) < full_length:
            spiral += _nearest(vertex, spiral, full_length, template)
        if dilation > 1 or full_length < length:
            # Every so many, then the ones between if vertices are scarce, then the vertex itself.
            between = [entry for i, entry in enumerate(spiral) if i % dilation]
            spiral = [*spiral[::dilation], *between, *[vertex] * length][:length]
        table[vertex] = spiral
    return table


def checked_faces(faces: Integers, n_vertices: int) -> Indices:
    """Faces (F, 3) as int64, without degenerate ones; refuses indices beyond the vertices."""
    corners = np.asarray(faces, np.int64).reshape(-1, 3)
    if corners.size and not (corners.min() >= 0 and corners.max() < n_vertices):
        raise FaceDiffError(
            f"faces: indices from {corners.min()} to {corners.max()}, but the template has {n_vertices} vertices; "
            f"use the mesh that belongs to the template"
        )
    first, second, third = corners.T
    return corners[(first != second) & (second != third) & (third != first)]


def ordered_rings(faces: Indices, n_vertices: int) -> list[list[int]]:
    """The neighbours of every vertex, counter-clockwise.

    A closed fan of faces begins at the neighbour with the smallest index, an open one at its end. Where faces do not
    form one fan (a border touched twice, more than two faces at an edge, faces that wind against one another), the
    fans follow one another: open ones first, each kind by its smallest start; every neighbour comes once.
    """
    follows: list[dict[int, int]] = [{} for _ in range(n_vertices)]
    loose: dict[int, set[int]] = {}
    # A face (a, b, c) seen from outside says that around a, the neighbour c follows b. A second follower of the same
    # neighbour is an edge with more than two faces, or two faces that wind against one another.
    for a, b, c in faces.tolist():
        for vertex, neighbour, follower in ((a, b, c), (b, c, a), (c, a, b)):
            if follows[vertex].setdefault(neighbour, follower) != follower:
                loose.setdefault(vertex, set()).add(follower)
    rings = []
    for vertex, follow in enumerate(follows):
        # An open fan starts at the neighbour that follows no other; a closed one has no such neighbour.
        ends = set(follow.values())
        # Sorted, so that the order of a vertex's neighbours does not depend on the order of the faces in the file.
        starts = [*sorted(follow.keys() - ends), *sorted(follow.keys() & ends), *sorted(loose.get(vertex, ()))]
        ring: dict[int, None] = {}  # a set that keeps its order
        for start in starts:
            step: int | None = start
            while step is not None and step not in ring:
                ring[step] = None
                step = follow.get(step)
        rings.append(list(ring))
    return rings


def _spiral(vertex: int, rings: list[list[int]], full_length: int) -> list[int]:
    """The vertex and the rings around it, cut at ``full_length`` entries; shorter where the rings end."""
    ring = rings[vertex]
    spiral = [vertex, *ring]
    visited = set(spiral)
    while ring and len(spiral) < full_length:
        outer: list[int] = []
        for inner in ring:
            around = rings[inner]
            fresh = [near not in visited for near in around]
            if not any(fresh):
                continue
            # The first new vertex after an old one, counter-clockwise: the outer ring goes on where the inner one
            # ended.
            start = next((i for i, new in enumerate(fresh) if new and not fresh[i - 1]), 0)
            order = (*range(start, len(around)), *range(start))
            new = [around[i] for i in order if fresh[i]]
            visited.update(new)
            outer += new
            if len(spiral) + len(outer) >= full_length:
                break
        spiral += outer
        ring = outer
    return spiral[:full_length]


def _nearest(vertex: int, spiral: list[int], full_length: int, template: Floats | None) -> list[int]:
    """The vertices nearest to ``vertex`` that are not in the spiral, as many as it lacks."""
    assert template is not None  # noqa: S101 - for type checkers
    square = np.square(np.asarray(template, np.float64) - np.asarray(template[vertex], np.float64)).sum(axis=1)
    # No vertex comes twice.
    square[spiral] = np.inf
    count = full_length - len(spiral)
    # A partition finds the distance of the last one needed without sorting all vertices.
    reach = np.partition(square, count - 1)[count - 1]
    near = np.flatnonzero(square <= reach)  # by index, so that ties go to the smaller one
    nearest: list[int] = near[np.argsort(square[near], kind="stable")][:count].tolist()
    return nearest
