"""Numerical helpers in NumPy: a smooth step, and what SciPy does, which is larger than all the rest of the runtime."""

from __future__ import annotations

import importlib.util

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Floats = npt.NDArray[np.floating]
Integers = npt.NDArray[np.integer]

CHUNK = 2**19
"""Distances that are held in memory at a time: 25 MB with their steps."""

BLOCK = 128
"""Samples that pass a filter as one product of matrices."""


def smooth_step(values: npt.ArrayLike) -> Array:
    """3t² − 2t³ of values limited to 0 … 1: from 0 to 1 with flat ends."""
    t = np.clip(np.asarray(values, np.float64), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def has_scipy() -> bool:
    """Whether SciPy is installed."""
    return importlib.util.find_spec("scipy") is not None


def nearest_distances(points: Array, targets: Array, limit: float) -> Array:
    """Distance (P,) of each point (P, 3) to the nearest of others (Q, 3); infinite where it is ``limit`` or more."""
    rows = max(1, CHUNK // len(targets))
    parts = (points[begin : begin + rows, None] - targets[None] for begin in range(0, len(points), rows))
    nearest = np.concatenate([np.sqrt(np.square(apart).sum(-1).min(1)) for apart in parts])
    return np.where(nearest < limit, nearest, np.inf)


def solve_block_chain(diagonal: Array, coupling: Array, right: Array) -> Array:
    """The solution (T, K) of a symmetric positive definite system for a right side (T, K).

    It has blocks (T, K, K) on the diagonal and diagonal blocks (T − 1, K) next to them.
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


class RecursiveFilter:
    """Second-order sections one after the other, as SciPy's ``sosfilt`` runs them, for samples that arrive in pieces.

    Args:
        sections: (sections, 6): b0, b1, b2, 1, a1, a2.
    """

    def __init__(self, sections: npt.ArrayLike) -> None:
        rows = np.asarray(sections, np.float64)
        self._sections = [_Section(row) for row in rows]

    def feed(self, samples: npt.NDArray[np.floating]) -> npt.NDArray[np.float64]:
        """Filter more samples (n,)."""
        filtered = np.asarray(samples, np.float64)
        for section in self._sections:
            filtered = section.feed(filtered)
        return filtered


class _Section:
    """One second-order section in its state-space form, x' = A x + B u, y = C x + D u, by blocks of samples."""

    def __init__(self, row: npt.NDArray[np.float64]) -> None:
        b0, b1, b2, _, a1, a2 = row
        transition = np.array([[-a1, 1.0], [-a2, 0.0]])
        entry = np.array([b1 - a1 * b0, b2 - a2 * b0])
        powers = [np.eye(2)]
        for _ in range(BLOCK):
            powers.append(transition @ powers[-1])
        impulse = np.array([b0, *(float((powers[n] @ entry)[0]) for n in range(BLOCK - 1))])
        lag = np.arange(BLOCK)[:, None] - np.arange(BLOCK)[None]
        # The response to a block's samples in the same block; the response to its state; and the state after n samples.
        self._direct = np.where(lag >= 0, impulse[np.maximum(lag, 0)], 0.0)
        self._free = np.stack([power[0] for power in powers[:BLOCK]])
        self._entries = np.stack([power @ entry for power in powers[:BLOCK]])
        self._powers = powers
        self._state = np.zeros(2)

    def feed(self, samples: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        full = len(samples) // BLOCK * BLOCK
        blocks = samples[:full].reshape(-1, BLOCK)
        filtered = blocks @ self._direct.T
        gained = blocks @ self._entries[::-1]
        for row, gain in zip(filtered, gained, strict=True):
            row += self._free @ self._state
            self._state = self._powers[BLOCK] @ self._state + gain
        rest = samples[full:]
        count = len(rest)
        last = self._direct[:count, :count] @ rest + self._free[:count] @ self._state
        if count:
            self._state = self._powers[count] @ self._state + rest @ self._entries[:count][::-1]
        return np.concatenate([filtered.reshape(-1), last])
