"""Smoothing a series, finding where it turns, and pairing the turns of two series along a warping path."""

from __future__ import annotations

import torch
from torch import Tensor

from facediff.metrics.warping import Path


def smooth(series: Tensor, deviation: float) -> Tensor:
    """A series under a Gaussian filter.

    The filter reaches ⌊4 · deviation + ½⌋ frames to either side and its weights add up to 1. Beyond its ends
    the series is mirrored, the end frames included: c b a | a b c | c b a.

    Args:
        series: (frames,), float64.
        deviation: Standard deviation in frames; 0 leaves the series as it is.

    Returns:
        (frames,), float64.
    """
    radius = int(4 * deviation + 0.5)
    if radius == 0:
        return series
    weights = torch.exp(-0.5 * (torch.arange(radius + 1, dtype=torch.float64) / deviation).square())
    weights = weights / (2 * weights[1:].sum() + weights[0])
    frames = len(series)
    places = torch.arange(-radius, frames + radius).remainder(2 * frames)
    mirrored = series[torch.where(places < frames, places, 2 * frames - 1 - places)]
    out = mirrored[radius : radius + frames] * weights[0]
    # One order of additions for every frame: a plateau stays one, to the last digit, and turns nowhere.
    for reach in range(radius, 0, -1):
        earlier = mirrored[radius - reach : radius - reach + frames]
        later = mirrored[radius + reach : radius + reach + frames]
        out = out + (earlier + later) * weights[reach]
    return out


def extrema(series: list[float]) -> dict[int, int]:
    """Inner frames at which a series has a local maximum (1) or minimum (−1).

    A plateau higher, or lower, than both its neighbours counts once, at its middle (the earlier one of two).

    >>> extrema([0, 1, 1, 1, 0, 2, 3])
    {2: 1, 4: -1}
    """
    found = {}
    start = 0
    for end in range(1, len(series)):
        if series[end] == series[start]:
            continue
        if start:
            rises, falls = series[start - 1] < series[start], series[end] < series[start]
            if rises == falls:
                found[(start + end - 1) // 2] = 1 if falls else -1
        start = end
    return found


def matched_lags(path: Path, truth: list[float], prediction: list[float]) -> list[int]:
    """Lags |i − j| of the pairs of a path that turn alike.

    Args:
        path: Pairs of a frame of the truth and a frame of the prediction.
        truth: The series whose extrema are to be met.
        prediction: The series that should meet them.

    Returns:
        One lag for each pair at which both series have a maximum or both a minimum, and the prediction's
        frame lies between the truth's neighbouring extrema, or ends.
    """
    turns, predicted_turns = extrema(truth), extrema(prediction)
    places = sorted(turns)
    earliest = dict(zip(places, [0, *places], strict=False))
    latest = dict(zip(places, [*places[1:], len(truth) - 1], strict=False))
    return [
        abs(row - column)
        for row, column in path
        if row in turns and turns[row] == predicted_turns.get(column) and earliest[row] <= column <= latest[row]
    ]
