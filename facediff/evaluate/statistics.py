"""From the values of sequences to a score, and how sure it is."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.evaluate.report import Interval

Array = npt.NDArray[np.float64]

BLOCK = 2**20
"""Counts that are held at a time while resampling: memory does not grow with the number of resamples."""


def pooled(values: Array, weights: Array) -> Array:
    """Scores of sequences: Σ w v / Σ w.

    Args:
        values: (sequences, columns).
        weights: likewise; frames where all frames count alike, 1 where all sequences do.

    Returns:
        (columns,).
    """
    return np.asarray((values * weights).sum(0) / weights.sum(0))


def draws(sequences: int, resamples: int, seed: int) -> Iterator[Array]:
    """How often each sequence is in each resample, drawn with replacement, a block of resamples at a time.

    Args:
        sequences: how many there are, and how many are drawn for each resample.
        resamples: how many resamples.
        seed: of the random numbers.

    Yields:
        (resamples of the block, sequences).
    """
    random = np.random.default_rng(seed)
    step = max(1, BLOCK // sequences)
    shares = np.full(sequences, 1 / sequences)
    for start in range(0, resamples, step):
        yield random.multinomial(sequences, shares, min(step, resamples - start)).astype(np.float64)


@dataclass(frozen=True)
class Bootstrap:
    """Confidence intervals by resampling sequences (Efron's percentile interval).

    Args:
        resamples: how many; 0 for no intervals.
        level: share of the resamples inside an interval.
        seed: of the random numbers; equal seeds and numbers of sequences give the same resamples.

    Raises:
        FaceDiffError: if a number is out of range.
    """

    resamples: int = 1000
    level: float = 0.95
    seed: int = 0

    def __post_init__(self) -> None:
        """Check the numbers."""
        if self.resamples < 0:
            raise FaceDiffError(f"bootstrap is {self.resamples}; expected a number of resamples, or 0 for no intervals")
        if not 0 < self.level < 1:
            raise FaceDiffError(f"level is {self.level:g}; expected a share between 0 and 1, such as 0.95")
        if self.seed < 0:
            raise FaceDiffError(f"seed is {self.seed}; expected a whole number from 0")

    def scores(self, values: Array, weights: Array) -> Array | None:
        """The score of every resample: a ratio of sums, so that a sequence keeps the weight of its frames.

        Args:
            values: (sequences, columns).
            weights: likewise.

        Returns:
            (resamples, columns); None without resamples, or with a single sequence, of which they would tell nothing.
        """
        if not self.resamples or len(values) < 2:
            return None
        weighted = values * weights
        # einsum and not a matrix product: its digits do not depend on threads or on the processor's library.
        blocks = [
            np.einsum("rs,sc->rc", counts, weighted) / np.einsum("rs,sc->rc", counts, weights)
            for counts in draws(len(values), self.resamples, self.seed)
        ]
        return np.concatenate(blocks)

    def intervals(self, scores: Array | None, columns: int) -> list[Interval | None]:
        """The middle of the scores of the resamples, for each column.

        Args:
            scores: (resamples, columns), as :meth:`scores` gives them.
            columns: how many columns.
        """
        if scores is None:
            return [None] * columns
        ends = np.quantile(scores, [(1 - self.level) / 2, (1 + self.level) / 2], axis=0)
        return [Interval(float(low), float(high)) for low, high in ends.T]
