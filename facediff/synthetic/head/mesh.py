"""Meshes of quads of which the left half is built and the right half is its mirror image."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facediff.synthetic.geometry import Array
from facediff.synthetic.head.layout import Index


@dataclass(frozen=True)
class QuadMesh:
    """A symmetric mesh of quads with named vertices (V, 3) in mm and their colours.

    Attributes:
        quads: vertices of each face, counter-clockwise seen from outside, (Q, 4); a triangle repeats its last vertex.
        mirror: the vertex on the other side, (V,); on the midline the vertex itself.
        groups: vertices of the left half by name, in the order in which they were made.
    """

    vertices: Array
    quads: Index
    colours: NDArray[np.uint8]
    mirror: Index
    groups: dict[str, Index]

    @property
    def faces(self) -> Index:
        """The quads as triangles, (F, 3)."""
        triangles = np.concatenate([self.quads[:, [0, 1, 2]], self.quads[:, [0, 2, 3]]])
        first, second, third = triangles.T
        return triangles[(first != second) & (second != third) & (third != first)]

    def both(self, *prefixes: str) -> Index:
        """Sorted vertices on both sides of all groups with names that start with one of these."""
        left = [index for name, index in self.groups.items() if name.startswith(prefixes)]
        return np.unique(np.concatenate([*left, *(self.mirror[index] for index in left)]))


@dataclass
class HalfQuadMesh:
    """The left half (x >= 0) under construction; vertices with x = 0 belong to both halves."""

    points: list[Array] = field(default_factory=list)
    colours: list[Array] = field(default_factory=list)
    quads: list[Index] = field(default_factory=list)
    groups: dict[str, Index] = field(default_factory=dict)
    count: int = 0

    def add(self, name: str, points: ArrayLike, colour: ArrayLike) -> Index:
        """Add points (n, 3) under a name, in one colour (3,) or a colour each (n, 3); returns their numbers."""
        positions = np.array(points, dtype=np.float64)
        index = np.arange(self.count, self.count + len(positions))
        self.points.append(positions)
        self.colours.append(np.array(np.broadcast_to(np.asarray(colour, dtype=np.float64), positions.shape)))
        self.groups[name] = index
        self.count += len(positions)
        return index

    def at(self, name: str) -> Array:
        """The points of a group, (n, 3)."""
        return np.concatenate(self.points)[self.groups[name]]

    def strips(self, loops: Sequence[Index], *, closed: bool = False, clockwise: bool = True) -> None:
        """Join loops of equal length, each to the next; from outside, the first runs clockwise round the others."""
        for outer, inner in zip(loops, loops[1:], strict=False):
            a, b = (np.append(outer, outer[0]), np.append(inner, inner[0])) if closed else (outer, inner)
            corners = [a[:-1], b[:-1], b[1:], a[1:]] if clockwise else [b[1:], b[:-1], a[:-1], a[1:]]
            self.quads.append(np.stack(corners, axis=1))

    def fan(self, loop: Index, centre: int, *, closed: bool = True, clockwise: bool = True) -> None:
        """Join a loop to a point; from outside, the loop runs clockwise round it."""
        after = np.roll(loop, -1) if closed else loop[1:]
        before = loop if closed else loop[:-1]
        middle = np.full_like(before, centre)
        first, last = (before, after) if clockwise else (after, before)
        self.quads.append(np.stack([first, middle, middle, last], axis=1))

    def lid(self, loop: Index) -> None:
        """Close a loop with a row of quads from its one side to the other."""
        half = (len(loop) + 1) // 2
        near, opposite = loop[:half], loop[::-1][:half]
        self.quads.append(np.stack([near[:-1], opposite[:-1], opposite[1:], near[1:]], axis=1))

    def mirrored(self) -> QuadMesh:
        """Both halves: the left half's vertices, then the mirror images of all that are off the midline."""
        points, colours, quads = (np.concatenate(parts) for parts in (self.points, self.colours, self.quads))
        off = np.flatnonzero(points[:, 0] != 0.0)
        mirror = np.arange(self.count)
        mirror[off] = self.count + np.arange(len(off))
        return QuadMesh(
            vertices=np.concatenate([points, points[off] * np.array([-1.0, 1.0, 1.0])]),
            # The first vertex stays first, so that a triangle's repeated vertex keeps its place.
            quads=np.concatenate([quads, mirror[quads[:, [0, 3, 2, 1]]]]),
            colours=np.clip(np.rint(np.concatenate([colours, colours[off]])), 0, 255).astype(np.uint8),
            mirror=np.concatenate([mirror, off]),
            groups=dict(self.groups),
        )
