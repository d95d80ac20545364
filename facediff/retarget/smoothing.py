"""Smooth fields over a mesh that hold to what is known of them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]

ROUNDS = 400
SMALL = 1e-8


def edges_of(faces: Indices) -> Indices:
    """Edges (E, 2), each once."""
    both = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    both = np.unique(np.sort(both, axis=1), axis=0)
    return both[both[:, 0] != both[:, 1]]


def smooth_field(values: Array, trust: Array, edges: Indices, stiffness: float) -> Array:
    """The field with the least Σ trust (x − value)² + stiffness · Σ_edges (x_a − x_b)², (V, 3).

    Args:
        values: (V, 3) what is known.
        trust: (V,) how well, 0 to 1.
        edges: (E, 2).
        stiffness: 0 leaves the known values as they are.

    Returns:
        the field; zero on pieces of the mesh where nothing is known.
    """
    field, known = torch.from_numpy(values.copy()), torch.from_numpy(trust)[:, None]
    a, b = torch.from_numpy(edges[:, 0].copy()), torch.from_numpy(edges[:, 1].copy())
    degree = torch.bincount(torch.cat([a, b]), minlength=len(values)).to(field)[:, None]
    diagonal = known + stiffness * degree + 1e-9

    def matrix(x: Tensor) -> Tensor:
        step = stiffness * (x[a] - x[b])
        return (known + 1e-9) * x + torch.zeros_like(x).index_add_(0, a, step).index_add_(0, b, -step)

    # Conjugate gradients with the diagonal as preconditioner, the three coordinates at once.
    right = known * field
    x = right / diagonal
    left = right - matrix(x)
    better = left / diagonal
    direction, power = better.clone(), (left * better).sum(0)
    limit = SMALL**2 * (right * right / diagonal).sum(0) + 1e-300
    for _ in range(ROUNDS):
        if bool((power <= limit).all()):
            break
        moved = matrix(direction)
        length = power / (direction * moved).sum(0).clamp_min(1e-300)
        x, left = x + length * direction, left - length * moved
        better = left / diagonal
        new = (left * better).sum(0)
        direction, power = better + new / power.clamp_min(1e-300) * direction, new
    return x.numpy()


def averaging(trust: Array, faces: Indices) -> Tensor | None:
    """The sparse (V, V) matrix that gives each vertex (1 − trust) times the mean of its neighbours.

    Returns:
        the matrix; None where every vertex is trusted.
    """
    if (trust >= 1).all():
        return None
    edges = edges_of(faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0], minlength=len(trust))
    part = (1.0 - trust)[both[:, 0]] / degree[both[:, 0]]
    used = part > 0
    matrix = torch.sparse_coo_tensor(
        torch.from_numpy(both[used].T.copy()), torch.from_numpy(part[used]), (len(trust),) * 2, check_invariants=True
    )
    return matrix.coalesce()
