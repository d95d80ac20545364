"""The colour scale of a page's error heat map."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from facediff.takes import Take
from facediff.viewer.packing import millimetres

SHARE = 0.99
"""Share of the errors that the scale covers; what is larger gets the last colour."""
_FRAMES = 200
"""Frames looked at: enough for a percentile, little enough for memory."""
_SMALLEST = 0.1


def scale_end(truth: Take, others: Sequence[Take]) -> float:
    """Error in mm that gets the last colour: the 99th percentile of the worst take, rounded up to one digit.

    Args:
        truth: what the others are compared with.
        others: takes of the truth's topology and length.
    """
    chosen = np.unique(np.linspace(0, len(truth.vertices) - 1, _FRAMES).astype(int))
    right = np.asarray(truth.vertices[chosen], np.float64) * millimetres(truth)
    largest = _SMALLEST
    for take in others:
        errors = np.linalg.norm(np.asarray(take.vertices[chosen], np.float64) * millimetres(take) - right, axis=2)
        largest = max(largest, float(np.quantile(errors, SHARE)))
    return round_up(largest)


def round_up(value: float) -> float:
    """The next number of one digit.

    >>> [round_up(value) for value in (0.1, 0.34, 1.0, 2.1, 7.0, 91.0)]
    [0.1, 0.4, 1.0, 3.0, 7.0, 100.0]
    """
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return round(math.ceil(value / power - 1e-9) * power, 9)
