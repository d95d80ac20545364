"""The numbers of a report against SciPy, published values and formulas written out independently."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import binom, binomtest

from facediff.reporting.statistics import binomial_interval, binomial_p, share_between_raters, wilson_interval
from facediff.study.rating_statistics import (
    alpha_interval,
    bradley_terry,
    is_connected,
    krippendorff_alpha,
    raters_needed,
)

COUNTS = [(0, 7), (7, 7), (3, 7), (89, 120), (52, 120), (1, 1000)]


@pytest.mark.parametrize(("wins", "count"), COUNTS)
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_of_shares_are_those_of_scipy(wins: int, count: int, level: float) -> None:
    known = binomtest(wins, count)
    for ours, method in ((wilson_interval, "wilson"), (binomial_interval, "exact")):
        expected = known.proportion_ci(level, method=method)
        assert ours(wins, count, level) == pytest.approx((expected.low, expected.high), abs=1e-9)
        assert ours(wins, count, level)[0] <= wins / count <= ours(wins, count, level)[1]
    assert binomial_p(wins, count) == pytest.approx(binomtest(wins, count, 0.5).pvalue)


def comparisons(scores: np.ndarray, raters: int, each: int, rng: np.random.Generator, spread: float = 0) -> np.ndarray:
    """Wins (R, K, K) of raters who compare every pair ``each`` times."""
    wins = np.zeros((raters, len(scores), len(scores)))
    for row in range(raters):
        own = scores + spread * rng.normal(size=len(scores))
        for i, j in itertools.combinations(range(len(scores)), 2):
            won = rng.binomial(each, 1 / (1 + np.exp(own[j] - own[i])))
            wins[row, i, j] += won
            wins[row, j, i] += each - won
    return wins


def test_bradley_terry_scores_maximise_the_likelihood() -> None:
    wins = comparisons(np.array([0.8, 0.1, -0.3, -0.6]), 8, 3, np.random.default_rng(0))
    total = wins.sum(0)

    def loss(scores: np.ndarray) -> float:
        lead = scores[:, None] - scores[None]
        return float((total * np.log1p(np.exp(-lead))).sum())

    best = minimize(loss, np.zeros(4), method="BFGS", options={"gtol": 1e-9}).x
    found = bradley_terry(wins)
    np.testing.assert_allclose(found.scores, best - best.mean(), atol=1e-5)
    assert found.scores.sum() == pytest.approx(0, abs=1e-12)
    assert found.bounded
    assert not found.robust  # eight raters


def test_intervals_of_scores_cover_raters_who_differ() -> None:
    """Answers of one rater are alike here; intervals that take them as independent cover far less."""
    rng = np.random.default_rng(1)
    truth = np.array([0.5, 0.0, -0.5])
    inside = []
    for _ in range(150):
        found = bradley_terry(comparisons(truth, 40, 8, rng, spread=0.7))
        ends = found.intervals(0.95)
        inside.append((ends[:, 0] <= truth * 0.93) & (truth * 0.93 <= ends[:, 1]))  # a spread flattens the mean
        assert found.robust
    assert 0.90 < np.mean(inside) < 0.985


def test_conditions_that_always_win_get_finite_scores_and_say_so() -> None:
    wins = np.zeros((12, 3, 3))
    wins[:, 0, 1:] = 1
    wins[:, 1, 2] = 1
    found = bradley_terry(wins)
    assert not found.bounded
    assert np.isfinite(found.scores).all()
    assert list(np.argsort(-found.scores)) == [0, 1, 2]
    apart = np.zeros((1, 4, 4))
    apart[0, 0, 1] = apart[0, 2, 3] = 1
    assert not is_connected(apart)


def slow_alpha(units: list[list[str]]) -> float:
    """Krippendorff's alpha as one minus the disagreement of pairs within units over that of all pairs."""
    units = [unit for unit in units if len(unit) > 1]
    everything = [value for unit in units for value in unit]
    observed = sum(sum(a != b for a, b in itertools.permutations(unit, 2)) / (len(unit) - 1) for unit in units) / len(
        everything
    )
    expected = sum(a != b for a, b in itertools.permutations(everything, 2)) / (len(everything) * (len(everything) - 1))
    return 1 - observed / expected


def test_alpha_is_the_ratio_of_disagreements_and_krippendorffs_own_example() -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        units = [list(rng.choice(["a", "b", "c"], rng.integers(1, 7))) for _ in range(9)]
        assert krippendorff_alpha(units) == pytest.approx(slow_alpha(units))
    # Krippendorff (2011), "Computing Krippendorff's Alpha-Reliability", section A: two observers, binary data.
    binary = {"A": "0100000010", "B": "1110010000"}
    pairs = [[a, b] for a, b in zip(binary["A"], binary["B"], strict=True)]
    assert krippendorff_alpha(pairs) == pytest.approx(0.095, abs=5e-4)
    assert krippendorff_alpha([["a", "a"], ["b", "b", "b"]]) == 1
    low, high = alpha_interval(pairs, seed=0)
    assert low < 0.095 < high


def test_shares_between_raters_are_wider_where_raters_differ() -> None:
    alike = share_between_raters(np.full(40, 6.0), np.full(40, 10.0))
    apart = share_between_raters(np.repeat([10.0, 2.0], 20), np.full(40, 10.0), seed=3)
    assert alike == (0.6, 0.6)
    half = 1.96 * 0.4 / math.sqrt(40)
    assert apart == pytest.approx((0.6 - half, 0.6 + half), abs=0.015)


@pytest.mark.parametrize(("difference", "power", "level"), [(0.2, 0.8, 0.95), (0.25, 0.9, 0.99), (0.5, 0.8, 0.95)])
def test_so_many_answers_notice_the_difference_and_never_less_after(
    difference: float, power: float, level: float
) -> None:
    plan = raters_needed(difference, power=power, level=level)

    def of(count: int) -> float:
        rejected = [wins for wins in range(count + 1) if binomtest(wins, count, 0.5).pvalue <= 1 - level]
        return float(binom.pmf(rejected, count, 0.5 + difference).sum())

    assert plan.answers == plan.raters
    assert plan.power == pytest.approx(of(plan.answers))
    assert of(plan.answers - 1) < power
    assert all(of(count) >= power for count in range(plan.answers, plan.answers + 12))
