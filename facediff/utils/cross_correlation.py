"""How late one series is compared with another, by their cross-correlation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def lagged_correlation(late: Array, early: Array, lag: int, least: int) -> float:
    """Pearson's correlation of two series where ``early`` begins ``lag`` steps into ``late``.

    It is −∞ where fewer than ``least`` steps overlap.
    """
    first, last = max(0, -lag), min(len(early), len(late) - lag)
    if last - first < least:
        return -np.inf
    a, b = late[first + lag : last + lag], early[first:last]
    a, b = a - a.mean(), b - b.mean()
    scale = float(np.sqrt(np.square(a).sum() * np.square(b).sum()))
    return float((a * b).sum() / scale) if scale > 0 else 0.0


def correlations(late: Array, early: Array, furthest: int, least: int) -> Array:
    """The correlation at every lag from −``furthest`` to ``furthest``; see :func:`lagged_correlation`."""
    return np.array([lagged_correlation(late, early, lag, least) for lag in range(-furthest, furthest + 1)])


def peak(scores: Array) -> float:
    """The lag at which :func:`correlations` are highest, in steps: the top of a parabola through the best three."""
    best = int(scores.argmax())
    shift = 0.0
    if 0 < best < len(scores) - 1 and np.isfinite(scores[best - 1 : best + 2]).all():
        before, middle, after = scores[best - 1 : best + 2]
        curve = before - 2 * middle + after
        shift = 0.5 * float(before - after) / float(curve) if curve < 0 else 0.0
    return best - (len(scores) - 1) / 2 + shift
