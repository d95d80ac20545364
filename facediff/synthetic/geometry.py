"""Curves and hills that the head is made of."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def through(knots: ArrayLike, values: ArrayLike, at: ArrayLike) -> Array:
    """Interpolate with cubic Hermite pieces with slopes that never overshoot (Fritsch and Carlson, 1980).

    Knots (n,) rise; ``at`` has any shape, and outside the knots the end values hold.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    positions = np.clip(np.asarray(at, dtype=np.float64), x[0], x[-1])
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
    piece = np.clip(np.searchsorted(x, positions, side="right") - 1, 0, x.size - 2)
    t = (positions - x[piece]) / step[piece]
    return np.asarray(
        (1 + 2 * t) * (1 - t) ** 2 * y[piece]
        + t * (1 - t) ** 2 * step[piece] * tangent[piece]
        + t**2 * (3 - 2 * t) * y[piece + 1]
        + t**2 * (t - 1) * step[piece] * tangent[piece + 1]
    )


def spline(knots: ArrayLike, values: ArrayLike) -> Callable[[ArrayLike], Array]:
    """A natural cubic spline, which unlike :func:`through` has continuous curvature.

    Knots (n,) rise; values (n, K). The function takes places of any shape and gives (..., K); outside the knots the end
    values hold.
    """
    x, y = np.asarray(knots, dtype=np.float64), np.asarray(values, dtype=np.float64)
    step = np.diff(x)
    slope = np.diff(y, axis=0) / step[:, None]
    # The second derivatives at the knots: continuity of the first ones, and 0 at both ends.
    system, right = np.eye(x.size), np.zeros_like(y)
    for knot in range(1, x.size - 1):
        system[knot, knot - 1 : knot + 2] = step[knot - 1], 2 * (step[knot - 1] + step[knot]), step[knot]
        right[knot] = 6 * (slope[knot] - slope[knot - 1])
    bend = np.linalg.solve(system, right)

    def at(positions: ArrayLike) -> Array:
        inside = np.clip(np.asarray(positions, dtype=np.float64), x[0], x[-1])
        piece = np.clip(np.searchsorted(x, inside, side="right") - 1, 0, x.size - 2)
        width, before = step[piece][..., None], (inside - x[piece])[..., None]
        after = width - before
        return np.asarray(
            (bend[piece] * after**3 + bend[piece + 1] * before**3) / (6 * width)
            + (y[piece] / width - bend[piece] * width / 6) * after
            + (y[piece + 1] / width - bend[piece + 1] * width / 6) * before
        )

    return at


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
