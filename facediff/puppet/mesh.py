"""Assembling one half of a symmetric mesh and mirroring it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from facediff.puppet.curves import Array

Faces = NDArray[np.int64]


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh with named vertices.

    Attributes:
        vertices: Positions, shape (V, 3).
        faces: Vertex indices, counter-clockwise seen from outside, shape (F, 3).
        colours: Red, green, blue of every vertex in 0..255, shape (V, 3), uint8.
        mirror: Index of the vertex on the other side, shape (V,); its own on the midline.
        groups: Named lists of vertices of the left half (x >= 0), in the order in which they were made.
    """

    vertices: Array
    faces: Faces
    colours: NDArray[np.uint8]
    mirror: NDArray[np.int64]
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

    def mirrored(self) -> Mesh:
        """Both halves as one mesh: the left half's points, then the mirror images of all off the midline."""
        points, colours = np.concatenate(self.points), np.concatenate(self.colours)
        faces = np.concatenate(self.faces)
        faces = faces[(faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])]
        off = np.flatnonzero(points[:, 0] != 0.0)
        mirror = np.arange(self.count)
        mirror[off] = self.count + np.arange(len(off))
        other = mirror[faces][:, ::-1]
        double = np.concatenate([points, points[off] * np.array([-1.0, 1.0, 1.0])])
        return Mesh(
            vertices=double,
            faces=np.concatenate([faces, other]),
            colours=np.clip(np.rint(np.concatenate([colours, colours[off]])), 0, 255).astype(np.uint8),
            mirror=np.concatenate([mirror, off]),
            groups=dict(self.groups),
        )
