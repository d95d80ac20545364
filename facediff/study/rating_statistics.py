"""Bradley-Terry scores, agreement between raters, and how many raters a study needs.

Each follows one formula of the literature, named in its docstring.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.reporting.statistics import Array
from facediff.utils import ranges

STEPS, PRECISE = 200, 1e-10
FEW_RATERS = 10
"""With fewer raters, the variance between them is too uncertain to be used in place of the model's."""


@dataclass(frozen=True)
class BradleyTerry:
    """Scores of several conditions from comparisons of two at a time.

    Attributes:
        scores: natural logarithms of the strengths (K,), with mean 0: the chance that i is preferred to j is
            1 / (1 + exp(s_j - s_i)).
        covariance: of the scores (K, K).
        bounded: False if some condition was always (or never) preferred to the others, so that no finite score is most
            likely; half a win for each side of every pair was then added.
        robust: whether the covariance takes raters, and not single answers, as independent.
    """

    scores: Array
    covariance: Array
    bounded: bool
    robust: bool

    def intervals(self, level: float = 0.95) -> Array:
        """Lower and upper ends (K, 2) of each score, by the normal distribution."""
        from scipy.stats import norm

        half = float(norm.ppf((1 + level) / 2)) * np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        return np.stack([self.scores - half, self.scores + half], 1)


def bradley_terry(wins: Array) -> BradleyTerry:
    """Scores of Bradley and Terry (1952), by maximum likelihood.

    The covariance is the sandwich of Liang and Zeger (1986) with raters as clusters, from :data:`FEW_RATERS` raters on;
    of fewer, the inverse of the information.

    Args:
        wins: (R, K, K): how often rater r preferred i to j; half for no difference. All conditions are connected by
            comparisons (:func:`is_connected`), or their scores have no common scale.

    Example:
        >>> result = bradley_terry(np.array([[[0.0, 3.0], [1.0, 0.0]]]))
        >>> bool(np.isclose(result.scores[0] - result.scores[1], np.log(3)))
        True
    """
    conditions = wins.shape[1]
    total = wins.sum(0)
    bounded = _components(total, strong=True) == 1
    played = wins + wins.transpose(0, 2, 1)
    if not bounded:
        total = total + 0.5 * (total + total.T > 0)
    counts = total + total.T
    scores = np.zeros(conditions)
    centre = np.full((conditions, conditions), 1 / conditions)
    for _ in range(STEPS):  # Newton; the likelihood is concave, and the mean of the scores is free
        chance = 1 / (1 + np.exp(scores[None] - scores[:, None]))
        gradient = (total - counts * chance).sum(1)
        weight = counts * chance * (1 - chance)
        information = np.diag(weight.sum(1)) - weight
        step = np.linalg.solve(information + centre, gradient)
        scores += step * min(1.0, 2 / max(np.abs(step).max(), PRECISE))
        if np.abs(step).max() < PRECISE:
            break
    scores -= scores.mean()
    inverse = np.linalg.inv(information + centre) - centre
    robust = bounded and len(wins) >= FEW_RATERS
    if robust:
        parts = (wins - played * chance).sum(2)  # each rater's share of the gradient
        scatter = parts.T @ parts * len(wins) / (len(wins) - 1)
        inverse = inverse @ scatter @ inverse
    return BradleyTerry(scores, inverse, bounded, robust)


def is_connected(wins: Array) -> bool:
    """Whether comparisons (R, K, K) connect all conditions, so that their scores have a common scale."""
    total = wins.sum(0)
    return _components(total + total.T) == 1


def _components(links: Array, *, strong: bool = False) -> int:
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components

    kind = "strong" if strong else "weak"
    return int(connected_components(csr_array(links > 0), directed=True, connection=kind, return_labels=False))


def krippendorff_alpha(units: Sequence[Sequence[str]]) -> float:
    """Krippendorff's (2011) alpha for nominal data: agreement beyond chance, 1 if all agree and 0 if chance rules.

    Args:
        units: the judgements of each unit; units with fewer than two do not count.

    Returns:
        alpha; NaN if no two judgements can be compared, or all are alike everywhere.

    Example:
        >>> round(krippendorff_alpha([["a", "a"], ["a", "b"], ["b", "b"], ["b", "b"]]), 4)
        0.5333
    """
    usable = [unit for unit in units if len(unit) > 1]
    values = sorted({value for unit in usable for value in unit})
    counts = np.array([[unit.count(value) for value in values] for unit in usable], np.float64)
    return _alpha(counts) if usable else math.nan


def _alpha(counts: Array) -> float:
    """Alpha of how often each value was given to each unit (U, C)."""
    judged = counts.sum(1)
    every = counts.sum(0)
    total = every.sum()
    observed = float((counts * (judged[:, None] - counts) / (judged - 1)[:, None]).sum())
    expected = float((every * (total - every)).sum()) / (total - 1) if total > 1 else 0.0
    return float(1 - observed / expected) if expected else math.nan


def alpha_interval(
    units: Sequence[Sequence[str]], level: float = 0.95, *, resamples: int = 1000, seed: int = 0
) -> tuple[float, float]:
    """Percentile interval of alpha over units that are drawn again with replacement; NaN where alpha is."""
    usable = [unit for unit in units if len(unit) > 1]
    if len(usable) < 2 or not resamples:
        return math.nan, math.nan
    values = sorted({value for unit in usable for value in unit})
    counts = np.array([[unit.count(value) for value in values] for unit in usable], np.float64)
    rng = np.random.default_rng(seed)
    alphas = np.array([_alpha(counts[rng.integers(0, len(counts), len(counts))]) for _ in range(resamples)])
    alphas = alphas[np.isfinite(alphas)]
    if not len(alphas):
        return math.nan, math.nan
    lower, upper = np.quantile(alphas, [(1 - level) / 2, (1 + level) / 2])
    return float(lower), float(upper)


def _powers(counts: npt.NDArray[np.int64], share: float, level: float) -> Array:
    from scipy.stats import binom

    # The largest number of wins that is still rejected at the lower end; the upper end mirrors it.
    low = binom.ppf((1 - level) / 2, counts, 0.5)
    low = np.where(binom.cdf(low, counts, 0.5) > (1 - level) / 2, low - 1, low)
    power: Array = binom.cdf(low, counts, share) + binom.sf(counts - low - 1, counts, share)
    return np.where(low < 0, 0.0, power)


@dataclass(frozen=True)
class PowerPlan:
    """The number of raters that a study needs.

    Attributes:
        raters: that are needed.
        answers: independent answers to one comparison that are needed.
        power: the chance that the difference is noticed with so many.
        design_effect: by how much answers of the same rater being alike raises the number.
    """

    raters: int
    answers: int
    power: float
    design_effect: float


@ranges.checked
def raters_needed(
    difference: ranges.Preference,
    *,
    power: ranges.Power = 0.8,
    level: ranges.Level = 0.95,
    per_rater: ranges.PerRater = 1,
    correlation: ranges.Correlation = 0.1,
    comparisons: ranges.PerRater = 1,
) -> PowerPlan:
    """The number of raters that detect a difference of preference.

    Answers are counted by the exact two-sided binomial test against one half, at the level of Bonferroni where there
    are several comparisons; the number is the smallest from which on the power is never less. Answers of one rater are
    alike: their number is raised by the design effect of Kish (1965), 1 + (k - 1) ρ.

    Args:
        difference: how far the share lies above one half: 0.1 for 60 to 40.
        power: the chance that a difference of this size is noticed.
        level: one minus the chance that a difference is seen where there is none.
        per_rater: answers of one rater to one comparison, k.
        correlation: of two answers of one rater to one comparison, ρ.
        comparisons: that are made, of which none may be wrong.

    Example:
        >>> plan = raters_needed(0.1, per_rater=4, correlation=0.1)
        >>> plan.answers, plan.raters
        (210, 69)
    """
    share, corrected = 0.5 + difference, 1 - (1 - level) / comparisons
    from scipy.stats import norm

    z = norm.ppf((1 + corrected) / 2) + norm.ppf(power)
    limit = math.ceil(2 * (0.5 * z / difference) ** 2) + 60
    counts = np.arange(1, limit + 1)
    powers = _powers(counts, share, corrected)
    # The power goes up and down by turns, since wins are whole numbers.
    answers = int(counts[np.flatnonzero(powers < power).max() + 1])
    effect = 1 + (per_rater - 1) * correlation
    return PowerPlan(math.ceil(answers * effect / per_rater), answers, float(powers[answers - 1]), effect)
