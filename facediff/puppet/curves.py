"""Smooth curves through a few values: the only interpolation that the puppet's parts need."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def through(knots: ArrayLike, values: ArrayLike, at: ArrayLike) -> Array:
    """Interpolate with cubic Hermite pieces whose slopes never overshoot (Fritsch and Carlson, 1980).

    Args:
        knots: Rising places of the values, shape (n,).
        values: Values there, shape (n,).
        at: Where to look, any shape; outside the knots the end values hold.

    Returns:
        Values with a continuous first derivative, the shape of ``at``.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    places = np.clip(np.asarray(at, dtype=np.float64), x[0], x[-1])
    step = np.diff(x)
    slope = np.diff(y) / step
    tangent = np.zeros_like(y)
    before, after = slope[:-1], slope[1:]
    weight_before, weight_after = 2 * step[1:] + step[:-1], step[1:] + 2 * step[:-1]
    same_way = before * after > 0
    safe_before, safe_after = np.where(same_way, before, 1.0), np.where(same_way, after, 1.0)
    harmonic = (weight_before + weight_after) / (weight_before / safe_before + weight_after / safe_after)
    tangent[1:-1] = np.where(same_way, harmonic, 0.0)
    tangent[0], tangent[-1] = slope[0], slope[-1]
    piece = np.clip(np.searchsorted(x, places, side="right") - 1, 0, x.size - 2)
    t = (places - x[piece]) / step[piece]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * y[piece]
        + t * (1 - t) ** 2 * step[piece] * tangent[piece]
        + t**2 * (3 - 2 * t) * y[piece + 1]
        + t**2 * (t - 1) * step[piece] * tangent[piece + 1]
    )


def rise(values: ArrayLike, low: ArrayLike, high: ArrayLike) -> Array:
    """Go from 0 at ``low`` to 1 at ``high`` with flat ends (smoothstep); ``low`` may lie above ``high``."""
    start, end = np.asarray(low, dtype=np.float64), np.asarray(high, dtype=np.float64)
    t = np.clip((np.asarray(values, dtype=np.float64) - start) / (end - start), 0.0, 1.0)
    return np.asarray(t * t * (3 - 2 * t))


def bump(x: ArrayLike, y: ArrayLike, centre: tuple[float, float], width: tuple[float, float]) -> Array:
    """Gaussian hill of height 1 over the plane, with standard deviations ``width`` along x and y."""
    across = (np.asarray(x, dtype=np.float64) - centre[0]) / width[0]
    along = (np.asarray(y, dtype=np.float64) - centre[1]) / width[1]
    return np.asarray(np.exp(-0.5 * (across**2 + along**2)))
