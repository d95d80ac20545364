"""The plane in which a face is its own mirror image, nearly so for scans."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facediff.utils.numerics import Array, Floats

SAMPLES = 3000  # Vertices that are mirrored, at most
ROUNDS = 25
INLIERS = 0.8  # Share of the nearest pairs that counts, without details of one side alone
SETTLED = 1e-9


@dataclass(frozen=True, eq=False)
class Plane:
    """The points p with normal · p = offset."""

    normal: Array  # (3,) unit length
    offset: float

    def mirror(self, points: Array) -> Array:
        """Mirror images (N, 3) of points."""
        away = points @ self.normal - self.offset
        return np.asarray(points - 2.0 * away[:, None] * self.normal)


def symmetry_plane(vertices: Floats, start: Plane) -> Plane:
    """The plane that mirrors a set of points onto itself best, searched for from a first guess.

    Mirror images are paired with their nearest points, and the best plane of the pairs is computed, in rounds: of pairs
    (p, q) around their means, the normal is the direction n with the least Σ (n · p)(n · q).

    Args:
        vertices: (V, 3) of the face.
        start: a plane that lies no further off than a few tens of degrees.

    Example:
        >>> points = np.random.default_rng(0).normal(size=(500, 3)) * [1, 2, 3]
        >>> both = np.concatenate([points, points * [-1, 1, 1]]) + [5, 0, 0]
        >>> plane = symmetry_plane(both, Plane(np.array([0.98, 0.2, 0.0]), 4.5))
        >>> plane.normal.round(6).tolist(), round(plane.offset, 6)
        ([1.0, 0.0, 0.0], 5.0)
    """
    from scipy.spatial import cKDTree

    points = np.asarray(vertices, np.float64)
    tree = cKDTree(points)
    some = points if len(points) <= SAMPLES else np.random.default_rng(0).choice(points, SAMPLES, replace=False)
    size = float(np.ptp(points, axis=0).max())
    plane = start
    for _ in range(ROUNDS):
        away, index = tree.query(plane.mirror(some))
        # Points without a mirror image, as of a parting or a scar, must not turn the plane.
        inliers = away <= np.quantile(away, INLIERS)
        first, second = some[inliers], points[index[inliers]]
        centre = 0.5 * (first.mean(axis=0) + second.mean(axis=0))
        product = (first - first.mean(axis=0)).T @ (second - second.mean(axis=0))
        normal = np.linalg.eigh(product + product.T)[1][:, 0]
        # An eigenvector has no sign; the first guess tells left from right.
        normal = normal if normal @ start.normal > 0 else -normal
        mirror = Plane(normal, float(normal @ centre))
        moved = np.linalg.norm(mirror.normal - plane.normal) * size + abs(mirror.offset - plane.offset)
        plane = mirror
        if moved < SETTLED * size:
            break
    return plane
