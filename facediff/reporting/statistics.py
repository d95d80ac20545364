"""Intervals by resampling, intervals of shares, and tests of differences.

SciPy has the distributions. The bootstrap and the permutations are written out here: a score is a ratio of sums in
which sequences keep the weight of their frames, and the random numbers follow from the seed that a report states.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.utils import ranges

Array = npt.NDArray[np.float64]

BLOCK = 2**20  # Counts that are held at a time while resampling: memory does not grow with the number of resamples
EXACT = 14
"""Up to so many sentences, all signs are tried; of more, some at random."""
FLIPS = 20_000
SIGNS = 2_000  # Random signs that are held at a time


@dataclass(frozen=True)
class Interval:
    """A bootstrap confidence interval over sequences."""

    low: float
    high: float


def pooled(values: Array, weights: Array) -> Array:
    """Scores (columns,) of values (sequences, columns): Σ w v / Σ w, NaN where no sequence has a value.

    The weights are frames where all frames count alike, 1 where all sequences do, and 0 where there is no value.
    """
    with np.errstate(invalid="ignore"):
        return np.asarray((values * weights).sum(0) / weights.sum(0))


def draws(sequences: int, resamples: int, seed: int) -> Iterator[Array]:
    """How often each sequence is in each resample, drawn with replacement: (resamples of a block, sequences)."""
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
    """

    resamples: ranges.Resamples = 1000
    level: ranges.Level = 0.95
    seed: ranges.Seed = 0

    def __post_init__(self) -> None:
        ranges.check_options(self)

    def scores(self, values: Array, weights: Array) -> Array | None:
        """The score of every resample: a ratio of sums, so that a sequence keeps the weight of its frames.

        From values and weights (sequences, columns) to (resamples, columns); None without resamples, or with a single
        sequence, of which they would tell nothing.
        """
        if not self.resamples or len(values) < 2:
            return None
        weighted = values * weights
        # einsum and not a matrix product: its digits do not depend on threads or on the processor's library.
        with np.errstate(invalid="ignore"):  # resamples without any sequence that has a value are not used
            blocks = [
                np.einsum("rs,sc->rc", counts, weighted) / np.einsum("rs,sc->rc", counts, weights)
                for counts in draws(len(values), self.resamples, self.seed)
            ]
        return np.concatenate(blocks)

    def intervals(self, scores: Array | None, columns: int) -> list[Interval | None]:
        """The middle of the scores of the resamples (resamples, columns), for each column."""
        if scores is None:
            return [None] * columns
        ends = [(1 - self.level) / 2, (1 + self.level) / 2]
        valued = [column[~np.isnan(column)] for column in scores.T]
        return [Interval(*np.quantile(column, ends).tolist()) if len(column) else None for column in valued]


def sign_flip(differences: Array, *, seed: int = 0) -> float:
    """Two-sided p-value of a paired permutation test: each sentence's difference might as well have the other sign.

    Exact for few sentences; with more, the observed signs count as one of the random ones, so that p is never 0.

    Args:
        differences: the part of each sentence in the difference (sentences,).
        seed: of the random signs.

    Example:
        >>> sign_flip(np.array([1.0, 2.0, 3.0]))  # the two most extreme of eight
        0.25
    """
    count = len(differences)
    observed = abs(differences.sum())
    # Sums of the same numbers in another order differ in the last digits, and must count as equal.
    limit = observed - 1e-12 * np.abs(differences).sum()
    if not count:
        return 1.0
    if count <= EXACT:
        signs = 1 - 2 * ((np.arange(2**count)[:, None] >> np.arange(count)) & 1)
        return float(np.mean(np.abs(signs @ differences) >= limit))
    random = np.random.default_rng(seed)
    extreme = 0
    for _ in range(FLIPS // SIGNS):
        signs = random.integers(0, 2, (SIGNS, count)) * 2 - 1
        extreme += int(np.count_nonzero(np.abs(signs @ differences) >= limit))
    return (extreme + 1) / (FLIPS + 1)


# Shares.


def wilson_interval(wins: float, count: float, level: float = 0.95) -> tuple[float, float]:
    """Wilson's (1927) score interval of the share ``wins / count``; 0 and 1 if nothing was counted.

    Example:
        >>> [round(end, 4) for end in wilson_interval(89, 120)]
        [0.6567, 0.8116]
    """
    if not count:
        return 0.0, 1.0
    from scipy.stats import norm

    z = float(norm.ppf((1 + level) / 2))
    share = wins / count
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    # Without a win, the lower end is 0, which rounding may miss.
    return (0.0 if wins <= 0 else middle - half), (1.0 if wins >= count else middle + half)


def binomial_p(wins: int, count: int) -> float:
    """Two-sided p value of the exact binomial test of a share against one half; 1 if nothing was counted.

    Example:
        >>> round(binomial_p(15, 20), 6)
        0.041389
    """
    if not count:
        return 1.0
    from scipy.stats import binomtest

    return float(binomtest(wins, count, 0.5).pvalue)


def share_between_raters(
    wins: Array, counts: Array, level: float = 0.95, *, resamples: int = 2000, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of a share over raters that are drawn again with replacement.

    Unlike intervals of single answers, it accounts for the similarity of one rater's answers.
    Wins and answers are of each rater (R,).
    """
    if not counts.sum():
        return 0.0, 1.0
    if len(counts) < 2 or not resamples:
        return math.nan, math.nan
    samples = np.random.default_rng(seed).multinomial(len(counts), np.full(len(counts), 1 / len(counts)), resamples)
    totals = samples @ counts
    shares = (samples @ wins)[totals > 0] / totals[totals > 0]
    lower, upper = np.quantile(shares, [(1 - level) / 2, (1 + level) / 2])
    return float(lower), float(upper)


# Several tests at a time.


def holm(values: Sequence[float]) -> list[float]:
    """Holm's step-down correction (1979): p-values of a family, such that the chance of any false one is bounded.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
    """
    order = np.argsort(values, kind="stable")
    adjusted = [0.0] * len(values)
    highest = 0.0
    for rank, index in enumerate(order.tolist()):
        highest = max(highest, min(1.0, (len(values) - rank) * values[index]))
        adjusted[index] = highest
    return adjusted
