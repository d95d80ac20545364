"""What SciPy does where it is installed, in NumPy where it is not: SciPy alone is as large as the whole runtime."""

from __future__ import annotations

import importlib.util
from typing import cast

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

CHUNK = 2**22
"""Distances that are held in memory at a time."""


def has_scipy() -> bool:
    """Whether SciPy is installed."""
    return importlib.util.find_spec("scipy") is not None


def nearest_distances(points: Array, others: Array, limit: float = np.inf) -> Array:
    """Distance (P,) of each point (P, 3) to the nearest of others (Q, 3); infinite where it is ``limit`` or more."""
    if has_scipy():
        from scipy.spatial import cKDTree

        return cast(Array, cKDTree(others).query(points, distance_upper_bound=limit)[0])
    return nearest_by_chunks(points, others, limit)


def nearest_by_chunks(points: Array, others: Array, limit: float = np.inf) -> Array:
    """The same by all distances."""
    rows = max(1, CHUNK // max(1, len(others)))
    nearest = np.empty(len(points))
    for begin in range(0, len(points), rows):
        apart = points[begin : begin + rows, None] - others[None]
        nearest[begin : begin + rows] = np.sqrt(np.square(apart).sum(-1).min(1))
    return np.where(nearest < limit, nearest, np.inf)


def solve_block_chain(diagonal: Array, coupling: Array, right: Array) -> Array:
    """Solve a symmetric positive definite system whose blocks are coupled to their neighbours by diagonal matrices.

    Args:
        diagonal: (T, K, K) the blocks on the diagonal.
        coupling: (T − 1, K) the diagonals of the blocks next to it.
        right: (T, K).

    Returns:
        the solution (T, K).
    """
    frames, count = right.shape
    solution = np.array(right, np.float64)
    inverses = np.empty((frames, count, count))
    for t in range(frames):  # elimination, block by block
        block = diagonal[t]
        if t:
            link = coupling[t - 1]
            block = block - link[:, None] * inverses[t - 1] * link
            solution[t] -= link * (inverses[t - 1] @ solution[t - 1])
        inverses[t] = np.linalg.inv(block)
    for t in reversed(range(frames)):
        after = coupling[t] * solution[t + 1] if t + 1 < frames else 0.0
        solution[t] = inverses[t] @ (solution[t] - after)
    return solution
