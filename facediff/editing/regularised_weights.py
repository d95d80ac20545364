"""Weights of blendshapes as Audio2Face-3D solves for them: least squares of a regularised Gram matrix's own system.

NVIDIA's solver minimises |A w − b|² and not the quadratic form that A and b belong to; both have one solution as long
as no weight meets a bound, and are up to 0.95 apart where some do. :func:`facediff.editing.blendshapes.solve` minimises
the distance of the vertices themselves; docs/methods.md compares both.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from facediff.editing.bounded import least_squares
from facediff.utils.numerics import Array, Floats, Integers

TemporalTerm = Literal["published", "corrected"]
"""How a weight is held near the last frame's: ``published`` has its factor of 100 on the left side only, which shrinks
the motion instead of smoothing it; ``corrected`` has it on both."""

L1, L2, TEMPORAL, SYMMETRY = 0.25, 10.0, 100.0, 10.0
"""Factors of the strengths."""

EXCLUDED = 1e-10
"""Upper bound of a weight that its partner excludes."""


@dataclass(frozen=True)
class Regularisation:
    """Strengths of the terms, for a face of a certain size; the defaults are NVIDIA's."""

    l1: float = 1.0  # keeps the sum of the weights small
    l2: float = 3.5  # keeps each weight small
    temporal: float = 0.0  # keeps weights near the frame before
    symmetry: float = 100.0  # keeps the weights of a symmetric pair alike
    template_size: float = 54.7  # diagonal of the face that the strengths are for; they grow with the square of it
    temporal_term: TemporalTerm = "published"


class RegularisedSolver:
    """Solves for weights from 0 to 1, frame after frame.

    Args:
        neutral: (V, 3) the face at rest.
        deltas: (K, V, 3) displacements at a weight of 1.
        mask: vertices that are compared; all if empty.
        regularisation: strengths of the terms.
        active: (K,) which shapes are used, the weights of others are 0; all if None.
        symmetric: pairs of shapes that are a left one and a right one.
        cancel: pairs of shapes that exclude one another: of each, the smaller weight is held at nearly 0.
        multipliers: (K,) factor of each weight that was solved for; 1 if None.
        offsets: (K,) added after the multiplication; 0 if None.

    Example:
        >>> neutral, deltas = np.eye(3) * 54.7, np.eye(9).reshape(9, 3, 3)[:2]
        >>> solver = RegularisedSolver(neutral, deltas, regularisation=Regularisation(l1=0, l2=0, symmetry=0))
        >>> solver.solve(neutral + 0.5 * deltas[:1] - deltas[1:]).tolist()
        [[0.5, 0.0]]
    """

    def __init__(
        self,
        neutral: Floats,
        deltas: Floats,
        *,
        mask: Integers | None = None,
        regularisation: Regularisation | None = None,
        active: Sequence[bool] | None = None,
        symmetric: Sequence[tuple[int, int]] = (),
        cancel: Sequence[tuple[int, int]] = (),
        multipliers: Sequence[float] | None = None,
        offsets: Sequence[float] | None = None,
    ) -> None:
        count = len(deltas)
        self.neutral, self.options = neutral, regularisation or Regularisation()
        self._rows: Any = slice(None) if mask is None or not len(mask) else np.asarray(mask, np.int64)
        self._used = np.arange(count) if active is None else np.flatnonzero(np.asarray(active, bool))
        self._factor = np.ones(count) if multipliers is None else np.asarray(multipliers, np.float64)
        self._offset = np.zeros(count) if offsets is None else np.asarray(offsets, np.float64)
        row = {int(shape): index for index, shape in enumerate(self._used)}
        # A pair counts only if both of its shapes are used.
        pairs = [[(row[i], row[j]) for i, j in group if i in row and j in row] for group in (symmetric, cancel)]
        self._cancel = pairs[1]
        # The size of the whole face, also of vertices outside of the mask.
        self._scale = float(np.square(np.ptp(neutral.astype(np.float64), axis=0)).sum()) / self.options.template_size**2
        self._shapes = deltas[self._used][:, self._rows].reshape(len(self._used), -1).astype(np.float64)
        self._matrix = self._shapes @ self._shapes.T + self._scale * self._penalty(pairs[0])

    def _penalty(self, symmetric: Sequence[tuple[int, int]]) -> Array:
        options, count = self.options, len(self._used)
        difference = np.zeros((len(symmetric), count))
        for row, (left, right) in enumerate(symmetric):
            difference[row, left], difference[row, right] = 1, -1
        # Weights are never negative, so that their sum is their L1 norm; its square stays in the quadratic problem.
        return np.asarray(
            L1 * options.l1**2 * np.ones((count, count))
            + (L2 * options.l2 + TEMPORAL * options.temporal) * np.eye(count)
            + SYMMETRY * options.symmetry * difference.T @ difference
        )

    def solve(self, vertices: Floats) -> Array:
        """Weights (T, K) of a motion, absolute vertices (T, V, 3); the face at rest goes before the first frame."""
        weights = np.zeros((len(vertices), len(self._factor)))
        last = np.zeros(len(self._used))
        towards = self._scale * self.options.temporal * (TEMPORAL if self.options.temporal_term == "corrected" else 1.0)
        # Frames are solved for one after the other, since the temporal term asks for the weights of the frame before.
        for frame, pose in enumerate(vertices):
            moved = (pose.astype(np.float64) - self.neutral)[self._rows].ravel()
            last = self._frame(self._shapes @ moved + towards * last, last)
            weights[frame, self._used] = last
        return weights * self._factor + self._offset

    def _frame(self, right: Array, last: Array) -> Array:
        lower, upper = np.zeros(len(right)), np.ones(len(right))
        weights = least_squares(self._matrix, right, lower, upper, last)
        if not self._cancel:
            return weights
        # Of two shapes that exclude one another the stronger is kept, and all others are solved for again without the
        # weaker one, to take over its share. Its bound is not quite 0, which the published solver needs.
        for i, j in self._cancel:
            upper[j if weights[i] >= weights[j] else i] = EXCLUDED
        return least_squares(self._matrix, right, lower, upper, weights)


def pairs_of(partners: Sequence[int]) -> list[tuple[int, int]]:
    """Pairs of indices with the same number, not negative.

    >>> pairs_of([0, -1, 1, 0, 1])
    [(0, 3), (2, 4)]
    """
    indices: dict[int, list[int]] = {}
    for index, number in enumerate(partners):
        if number >= 0:
            indices.setdefault(number, []).append(index)
    return [(pair[0], pair[1]) for pair in indices.values() if len(pair) == 2]
