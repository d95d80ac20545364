"""A recursive filter that runs without SciPy, which is larger than all the rest of the runtime."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Wave = npt.NDArray[np.floating]

BLOCK = 128
"""Samples whose response is one product of matrices."""


class RecursiveFilter:
    """Second-order sections one after the other, as SciPy's ``sosfilt`` runs them, for samples that arrive in pieces.

    Args:
        sections: (sections, 6): b0, b1, b2, 1, a1, a2.

    Example:
        >>> RecursiveFilter([[0.5, 0.5, 0, 1, 0, 0]]).feed(np.array([1.0, 1.0, 0.0]))  # the mean of two samples
        array([0.5, 1. , 0.5])
    """

    def __init__(self, sections: npt.ArrayLike) -> None:
        rows = np.asarray(sections, np.float64)
        self._sections = [_Section(row) for row in rows]

    def feed(self, samples: Wave) -> npt.NDArray[np.float64]:
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
        # What a block's samples give in the same block; what its state gives there; and the state after n samples.
        self._direct = np.where(lag >= 0, impulse[np.maximum(lag, 0)], 0.0)
        self._free = np.stack([power[0] for power in powers[:BLOCK]])
        self._entries = np.stack([power @ entry for power in powers[:BLOCK]])
        self._powers = powers
        self._state = np.zeros(2)

    def feed(self, samples: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        whole = len(samples) // BLOCK * BLOCK
        blocks = samples[:whole].reshape(-1, BLOCK)
        filtered = blocks @ self._direct.T
        gained = blocks @ self._entries[::-1]
        for row, gain in zip(filtered, gained, strict=True):
            row += self._free @ self._state
            self._state = self._powers[BLOCK] @ self._state + gain
        rest = samples[whole:]
        count = len(rest)
        last = self._direct[:count, :count] @ rest + self._free[:count] @ self._state
        if count:
            self._state = self._powers[count] @ self._state + rest @ self._entries[:count][::-1]
        return np.concatenate([filtered.reshape(-1), last])
