"""Intervals and tests of shares against SciPy and formulas written out independently."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import binomtest

from facediff.reporting.statistics import binomial_p, share_between_raters, wilson_interval


@pytest.mark.parametrize(("wins", "count"), [(0, 7), (7, 7), (3, 7), (89, 120), (52, 120), (1, 1000)])
@pytest.mark.parametrize("level", [0.9, 0.95, 0.99])
def test_intervals_of_shares_are_those_of_scipy(wins: int, count: int, level: float) -> None:
    expected = binomtest(wins, count).proportion_ci(level, method="wilson")
    low, high = wilson_interval(wins, count, level)
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-9)
    assert low <= wins / count <= high
    assert binomial_p(wins, count) == pytest.approx(binomtest(wins, count, 0.5).pvalue)


def test_shares_between_raters_are_wider_where_raters_differ() -> None:
    alike = share_between_raters(np.full(40, 6.0), np.full(40, 10.0))
    apart = share_between_raters(np.repeat([10.0, 2.0], 20), np.full(40, 10.0), seed=3)
    assert alike == (0.6, 0.6)
    half = 1.96 * 0.4 / math.sqrt(40)
    assert apart == pytest.approx((0.6 - half, 0.6 + half), abs=0.015)
