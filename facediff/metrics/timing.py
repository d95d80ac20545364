"""Metrics that let time stretch: lip dynamic time warping and mean temporal misalignment."""

from __future__ import annotations

from typing import Literal, Unpack

import torch
from torch import Tensor

from facediff.metrics.base import Clip, LipMetric, SequenceOptions, check_option, check_range, functional
from facediff.metrics.mouth import OpeningMetric
from facediff.metrics.regions import LipPairsLike
from facediff.registry import metric

# Dynamic time warping: the cheapest way to align two series without going back in time.

Path = list[tuple[int, int]]


def warp(distances: Tensor) -> tuple[float, Path]:
    """The cheapest warping path from the first pair of frames to the last.

    A path goes from (i, j) to (i + 1, j + 1), (i + 1, j) or (i, j + 1), and costs the sum of the distances of
    its pairs, both ends included (Sakoe and Chiba 1978, without slope weights or a band). Where ways cost the
    same, the path comes diagonally if it can, else from (i − 1, j).

    Time is O(rows · columns), vectorised along anti-diagonals of independent cells: about
    50 ms for two series of 600 frames on a CPU, to which the distances are moved.

    Args:
        distances: (rows, columns), not negative, finite.

    Returns:
        The cost, and the path as pairs of row and column.

    >>> warp(torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]))
    (1.0, [(0, 0), (1, 0), (2, 1)])
    """
    rows, columns = distances.shape
    skewed = _skew(distances.detach().double().cpu())
    # Row k + 2 holds the costs of anti-diagonal k, i + j = k, at column i + 1; what lies outside costs infinity.
    costs = torch.full((rows + columns + 1, rows + 1), torch.inf, dtype=torch.float64)
    costs[0, 0] = 0.0  # where the first pair comes from
    for diagonal in range(rows + columns - 1):
        before, last = costs[diagonal], costs[diagonal + 1]
        best = torch.minimum(before[:-1], torch.minimum(last[:-1], last[1:]))
        torch.add(best, skewed[diagonal], out=costs[diagonal + 2, 1:])
    return costs[-1, -1].item(), _trace(costs, rows, columns)


def _skew(distances: Tensor) -> Tensor:
    """(rows + columns − 1, rows): row k holds the pairs with i + j = k, infinity where there is none."""
    rows, columns = distances.shape
    padded = torch.full((rows, columns + rows), torch.inf, dtype=distances.dtype)
    padded[:, :columns] = distances
    # Read with rows one shorter than they are, each row begins one further to the right than the one before.
    width = rows + columns - 1
    return padded.flatten()[: rows * width].view(rows, width).T.contiguous()


def _trace(costs: Tensor, rows: int, columns: int) -> Path:
    """The path that leads to the last pair, from the costs by anti-diagonal."""
    diagonal, first = costs[:-2, :-1], costs[1:-1, :-1]
    second = costs[1:-1, 1:]
    diagonally = (diagonal <= first) & (diagonal <= second)
    steps = torch.where(diagonally, 0, torch.where(first <= second, 1, 2)).tolist()
    row, column = rows - 1, columns - 1
    path = [(row, column)]
    while row or column:
        step = steps[row + column][row]
        row, column = row - (step != 2), column - (step != 1)
        path.append((row, column))
    return path[::-1]


@metric.register("lip_warping_distance")
class LipWarpingDistance(LipMetric):
    """Lip DTW: distance between the lips of truth and prediction after time is warped to fit them best.

    With d(i, j) = √(mean_{v∈M} ‖g[i, v] − p[j, v]‖²), the root mean square distance between the lips of frame
    i of the truth and frame j of the prediction, the metric of a sequence is the smallest sum of d along a
    warping path from the first frames to the last, divided by the number of pairs on that path; then the mean
    over sequences, in the vertices' unit. See :func:`warp` for the path and its ties. A template cancels.

    The distance is never larger than the mean of d(t, t): the difference is error of timing.

    Imitator's paper reports a lip DTW; no released code of it is known, so the local distance, the norm and
    the mean over sequences are choices. Lengths follow the length rule first, as with every metric here.

    Time grows with the square of the frames: a clip of 600 frames and FLAME's 250 lip vertices takes about
    0.2 seconds on a CPU core, with BIWI's 4 996 some 3 seconds.

    >>> import torch
    >>> late = torch.zeros(4, 1, 3)
    >>> late[2:, 0, 0] = 1.0
    >>> early = late.roll(-1, 0)
    >>> early[-1, 0, 0] = 1.0
    >>> lip_warping_distance(late, early, [0]).item()
    0.0
    """

    higher_is_better = False
    in_order = True
    words = (
        "in each sequence the root mean square distance over {region} between frames that dynamic time warping pairs, "
        "mean along the path of smallest sum; mean over sequences [unit]"
    )

    def clip_value(self, clip: Clip) -> Tensor:
        """The distance of one sequence."""
        truth, prediction = (
            motion.index_select(1, self.indices).double().flatten(1) for motion in (clip.truth, clip.prediction)
        )
        # The quick way over |a|² + |b|² − 2ab would leave rounding where the distance should be exactly zero.
        distances = torch.cdist(truth, prediction, compute_mode="donot_use_mm_for_euclid_dist")
        cost, path = warp(distances / len(self.indices) ** 0.5)
        return torch.tensor(cost / len(path), dtype=torch.float64, device=truth.device)


lip_warping_distance = functional(LipWarpingDistance)


# Early or late: the opening's maxima and minima, paired along a warping path.


def smooth(series: Tensor, deviation: float) -> Tensor:
    """A series (frames,) float64 under a Gaussian filter of this standard deviation in frames; 0 leaves it as it is.

    The filter reaches ⌊4 · deviation + ½⌋ frames to either side and its weights add up to 1. Beyond its ends
    the series is mirrored, the end frames included: c b a | a b c | c b a.
    """
    radius = int(4 * deviation + 0.5)
    if radius == 0:
        return series
    weights = torch.exp(-0.5 * (torch.arange(radius + 1, dtype=torch.float64) / deviation).square())
    weights = weights / (2 * weights[1:].sum() + weights[0])
    frames = len(series)
    frames_around = torch.arange(-radius, frames + radius).remainder(2 * frames)
    mirrored = series[torch.where(frames_around < frames, frames_around, 2 * frames - 1 - frames_around)]
    out = mirrored[radius : radius + frames] * weights[0]
    # One order of additions for every frame: a plateau stays one, to the last digit, and has no extremum.
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
    turns = {}
    start = 0
    for end in range(1, len(series)):
        if series[end] == series[start]:
            continue
        if start:
            rises, falls = series[start - 1] < series[start], series[end] < series[start]
            if rises == falls:
                turns[(start + end - 1) // 2] = 1 if falls else -1
        start = end
    return turns


def matched_lags(path: Path, truth: list[float], prediction: list[float]) -> list[int]:
    """Lags |i − j| of the pairs of a path at which both series have a maximum or both a minimum.

    Only of pairs in which frame j of the prediction lies between the truth's neighbouring extrema, or ends.
    """
    turns, predicted_turns = extrema(truth), extrema(prediction)
    frames = sorted(turns)
    earliest = dict(zip(frames, [0, *frames], strict=False))
    latest = dict(zip(frames, [*frames[1:], len(truth) - 1], strict=False))
    return [
        abs(row - column)
        for row, column in path
        if row in turns and turns[row] == predicted_turns.get(column) and earliest[row] <= column <= latest[row]
    ]


Moments = Literal["extrema", "path"]
"""Which pairs of a warping path have their lag counted."""


@metric.register("temporal_misalignment")
class TemporalMisalignment(OpeningMetric):
    r"""Mean temporal misalignment (MTM): how many frames, or milliseconds, the mouth is early or late.

    The opening of the mouth over time (see :class:`MouthOpeningDifference`) is smoothed with a Gaussian, and
    derivative dynamic time warping aligns the prediction's with the truth's: the warping path of smallest sum of
    \|Δo_g[i] − Δo_p[j]\| with Δo[t] = o[t] − o[t − 1], Δo[0] = 0 (see :func:`warp` for the path and its ties).
    The misalignment of a sequence is the mean of \|i − j\| over

    - ``at="extrema"``: those pairs of the path at which both openings have a local maximum, or both a local
      minimum, and j lies between the extrema of the truth before and after i (its first and last frame where
      there is none). Extrema are inner frames; a plateau counts once, at its middle. A sequence without such
      a pair is left out, so a face that never moves has no misalignment at all.
    - ``at="path"``: every pair of the path. Every sequence has a value, but flat stretches, which a path
      crosses as rounding will have it, count as much as syllables.

    Then the mean over sequences, early and late alike.

    The name and the first definition are from "Perceptually Accurate 3D Talking Head Generation"
    (Chae-Yeon et al., CVPR 2025): the defaults follow its released script, which uses the one pair of FLAME
    vertices (3531, 3504), on all frames of the prediction and every second one of VOCASET's truth.
    ``at="path"`` is ours.

    Args:
        at: ``"extrema"`` as the CVPR 2025 paper's script, or ``"path"``.
        smoothing: standard deviation of the Gaussian in frames; 0 for none. It is cut off at 4 standard
            deviations, and the series is mirrored at its ends.
        frames_per_second: of the motion, for a result in milliseconds; None for frames.

    >>> import torch
    >>> truth = torch.zeros(40, 2, 3)
    >>> truth[:, 0, 1] = torch.linspace(0, 12, 40).sin() + 1
    >>> temporal_misalignment(truth.roll(2, 0), truth, [(0, 1)]).item()
    2.0
    """

    higher_is_better = False
    in_order = True
    leaves_out = "the warping path pairs no opening or closing of truth and prediction"

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        at: Moments = "extrema",
        smoothing: float = 2.0,
        frames_per_second: float | None = None,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("at", at, Moments)
        check_range("smoothing", smoothing, 0)
        if frames_per_second is not None:
            check_range("frames_per_second", frames_per_second, 1e-9)
        scope = "pairs of like extrema" if at == "extrema" else "all its pairs"
        smoothed = f"smoothed over {smoothing:g} frames" if smoothing else "not smoothed"
        unit = "frames" if frames_per_second is None else "ms"
        definition = (
            "in each sequence the mean lag |i − j| on the path of derivative dynamic time warping between "
            f"the mouth's openings (mean distance of {{pairs}}, {smoothed}), over {scope}; mean over sequences "
            f"[{unit}]"
        )
        super().__init__(pairs, definition=definition, **options)
        self.at: Moments = at
        self.smoothing = smoothing
        self.frames_per_second = frames_per_second

    def clip_value(self, clip: Clip) -> Tensor:
        """The misalignment of one sequence, NaN if no extrema are paired."""
        predicted, true = (smooth(series.cpu(), self.smoothing) for series in self.openings(clip))
        change, true_change = (series.diff(prepend=series[:1]) for series in (predicted, true))
        _, path = warp((true_change[:, None] - change[None, :]).abs())
        if self.at == "path":
            lags = [abs(row - column) for row, column in path]
        else:
            lags = matched_lags(path, true.tolist(), predicted.tolist())
        mean = sum(lags) / len(lags) if lags else float("nan")
        unit = 1.0 if self.frames_per_second is None else 1000.0 / self.frames_per_second
        return torch.tensor(mean * unit, dtype=torch.float64, device=clip.truth.device)


temporal_misalignment = functional(TemporalMisalignment)
