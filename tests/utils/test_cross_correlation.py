from __future__ import annotations

import numpy as np
import pytest

from facediff.utils.cross_correlation import correlations, lagged_correlation, peak


@pytest.mark.parametrize("late", [0.0, 1.0, -2.4, 3.5])
def test_a_planted_lag_is_found_between_the_steps(late: float) -> None:
    times = np.arange(120.0)

    def series(at: np.ndarray) -> np.ndarray:
        return np.sin(at / 3) + np.sin(at / 7 + 1) + 5

    scores = correlations(series(times - late), series(times), 8, 40)
    assert peak(scores) == pytest.approx(late, abs=0.1)


def test_too_little_overlap_is_no_lag() -> None:
    ramp = np.arange(20.0)
    assert lagged_correlation(ramp, ramp, 12, 10) == -np.inf
    assert lagged_correlation(ramp, ramp, 3, 10) == pytest.approx(1.0)
    assert lagged_correlation(ramp, np.ones(20), 0, 10) == 0.0
