"""Metrics that let time stretch: lip dynamic time warping and mean temporal misalignment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, get_args

import torch
from torch import Tensor

from facediff.metrics.base import ComparisonMetric
from facediff.metrics.clips import Clip, Lengths
from facediff.metrics.extrema import matched_lags, smooth
from facediff.metrics.lip_pairs import LipPairsLike
from facediff.metrics.mouth import OpeningMetric
from facediff.metrics.options import LengthRule, check_option
from facediff.metrics.regions import RegionLike, as_region
from facediff.metrics.warping import warp

Moments = Literal["extrema", "path"]
"""Which pairs of a warping path have their lag counted."""

MOMENTS: tuple[Moments, ...] = get_args(Moments)


class LipWarpingDistance(ComparisonMetric):
    """Lip DTW: distance between the lips of truth and prediction after time is warped to fit them best.

    With d(i, j) = √(mean_{v∈M} ‖g[i, v] − p[j, v]‖²), the root mean square distance between the lips of frame
    i of the truth and frame j of the prediction, the metric of a sequence is the smallest sum of d along a
    warping path from the first frames to the last, divided by the number of pairs on that path; then the mean
    over sequences, in the vertices' unit. See `warp` for the path and its ties. A template cancels.

    The distance is never larger than the mean of d(t, t): what it is smaller by is error of timing.

    Imitator's paper reports a lip DTW; no released code of it is known, so the local distance, the norm and
    the mean over sequences are choices. Lengths follow the length rule first, as with every metric here.

    Time grows with the square of the frames: a clip of 600 frames and FLAME's 250 lip vertices takes about
    0.2 seconds on a CPU core, with BIWI's 4 996 some 3 seconds.

    Args:
        lips: Lip vertices, a `Region` or indices.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    >>> import torch
    >>> late = torch.zeros(4, 1, 3)
    >>> late[2:, 0, 0] = 1.0
    >>> early = late.roll(-1, 0)
    >>> early[-1, 0, 0] = 1.0
    >>> lip_warping_distance(late, early, [0]).item()
    0.0
    """

    higher_is_better = False
    indices: Tensor

    def __init__(
        self, lips: RegionLike, *, length_rule: LengthRule = "min", check_finite: bool = True, **kwargs: object
    ) -> None:
        region = as_region(lips, "lips")
        super().__init__(
            definition=f"in each sequence the root mean square distance over {region} between frames that dynamic "
            "time warping pairs, mean along the path of smallest sum; mean over sequences [unit]",
            pooling="sequences",
            region=region,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
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


class TemporalMisalignment(OpeningMetric):
    r"""Mean temporal misalignment (MTM): how many frames, or milliseconds, the mouth is early or late.

    The opening of the mouth over time (see `MouthOpeningDifference`) is smoothed with a Gaussian, and
    derivative dynamic time warping lays the prediction's upon the truth's: the warping path of smallest sum of
    \|Δo_g[i] − Δo_p[j]\| with Δo[t] = o[t] − o[t − 1], Δo[0] = 0 (see `warp` for the path and its ties).
    The misalignment of a sequence is the mean of \|i − j\| over

    - ``at="extrema"``: those pairs of the path at which both openings have a local maximum, or both a local
      minimum, and j lies between the extrema of the truth before and after i (its first and last frame where
      there is none). Extrema are inner frames; a plateau counts once, at its middle. A sequence without such
      a pair is left out, so a face that never moves has no misalignment at all.
    - ``at="path"``: every pair of the path. Every sequence has a value, but flat stretches, which a path
      crosses as rounding will have it, count as much as syllables.

    Then the mean over sequences, early and late alike.

    The name and the first definition are those of "Perceptually Accurate 3D Talking Head Generation"
    (Chae-Yeon et al., CVPR 2025): the defaults follow its released script, which uses the one pair of FLAME
    vertices (3531, 3504), on all frames of the prediction and every second one of VOCASET's truth.
    ``at="path"`` is ours.

    Args:
        pairs: Lip vertex pairs, `LipPairs` or pairs of indices.
        at: ``"extrema"`` or ``"path"``.
        smoothing: Standard deviation of the Gaussian in frames; 0 for none. It is cut off at 4 standard
            deviations, and the series is mirrored at its ends.
        frames_per_second: Of the motion, for a result in milliseconds; None for frames.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: If an option is unknown or out of range.

    >>> import torch
    >>> truth = torch.zeros(40, 2, 3)
    >>> truth[:, 0, 1] = torch.linspace(0, 12, 40).sin() + 1
    >>> temporal_misalignment(truth.roll(2, 0), truth, [(0, 1)]).item()
    2.0
    """

    higher_is_better = False
    leaves_out = "the warping path pairs no opening or closing of truth and prediction"

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        at: Moments = "extrema",
        smoothing: float = 2.0,
        frames_per_second: float | None = None,
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("at", at, MOMENTS)
        if not 0 <= smoothing < float("inf"):
            raise ValueError(f"smoothing is {smoothing}; expected a number of frames, 0 for none")
        if frames_per_second is not None and not 0 < frames_per_second < float("inf"):
            raise ValueError(f"frames_per_second is {frames_per_second}; expected a positive number")
        places = "pairs of like extrema" if at == "extrema" else "all its pairs"
        smoothed = f"smoothed over {smoothing:g} frames" if smoothing else "not smoothed"
        unit = "frames" if frames_per_second is None else "ms"
        super().__init__(
            pairs,
            definition="in each sequence the mean lag |i − j| on the path of derivative dynamic time warping between "
            f"the mouth's openings (mean distance of {{pairs}}, {smoothed}), over {places}; mean over sequences "
            f"[{unit}]",
            pooling="sequences",
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
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


def lip_warping_distance(
    prediction: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Lip DTW: mean distance of the lips along the best warping path, see `LipWarpingDistance`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        lips: Lip vertices, a `Region` or indices.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit.

    Raises:
        ValueError: As `LipWarpingDistance.update`.
    """
    metric = LipWarpingDistance(lips, length_rule=length_rule, sync_on_compute=False).to(truth.device)
    metric.update(prediction, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def temporal_misalignment(
    prediction: Tensor,
    truth: Tensor,
    pairs: LipPairsLike,
    *,
    offsets_from: Tensor | None = None,
    at: Moments = "extrema",
    smoothing: float = 2.0,
    frames_per_second: float | None = None,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Mean temporal misalignment (MTM) of the mouth's opening, see `TemporalMisalignment`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        pairs: Lip vertex pairs, `LipPairs` or pairs of indices.
        offsets_from: Neutral vertices that prediction and truth are offsets from; None if they are absolute.
        at: ``"extrema"`` as the CVPR 2025 paper's script, or ``"path"``.
        smoothing: Standard deviation of the Gaussian in frames; 0 for none.
        frames_per_second: Of the motion, for a result in milliseconds; None for frames.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in frames, or in milliseconds.

    Raises:
        ValueError: As `OpeningMetric.update`, and if no sequence has extrema that are paired.
    """
    metric = TemporalMisalignment(
        pairs,
        at=at,
        smoothing=smoothing,
        frames_per_second=frames_per_second,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(
        prediction,
        truth,
        offsets_from=offsets_from,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
