"""Pearson correlation over time between what the lips of truth and prediction do."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from facediff.metrics.base import ComparisonMetric
from facediff.metrics.clips import Clip, Lengths
from facediff.metrics.formulas import correlation, speed
from facediff.metrics.lip_pairs import LipPairsLike
from facediff.metrics.mouth import OpeningMetric
from facediff.metrics.options import LengthRule
from facediff.metrics.regions import RegionLike, as_region

_RULE = "a prediction that does not vary counts 0, a sequence whose truth does not vary is left out"


class LipOpeningCorrelation(OpeningMetric):
    """Lip PCC of the opening: does the mouth open when the truth's does, whatever the amount?

    Per sequence Pearson's correlation over frames between o_g and o_p, the openings of the mouth (see
    `MouthOpeningDifference`); then the mean over sequences. From −1 to 1, without unit; blind to the
    size of the movement and to a constant gap.

    A prediction that does not vary counts 0. A truth that does not vary, as in a clip of one frame, cannot be
    followed: the sequence is left out and `coverage` says so. Both are choices, as is the mean over sequences.

    Args:
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    higher_is_better = True
    leaves_out = "the opening of the truth does not vary"

    def __init__(
        self, pairs: LipPairsLike, *, length_rule: LengthRule = "min", check_finite: bool = True, **kwargs: object
    ) -> None:
        super().__init__(
            pairs,
            definition="in each sequence the Pearson correlation over frames between the openings of the mouth, an "
            f"opening being the mean distance of {{pairs}}; mean over sequences; {_RULE} [1]",
            pooling="sequences",
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The correlation of one sequence, NaN if the truth does not vary."""
        predicted, true = self.openings(clip)
        return correlation(true, predicted)


class LipSpeedCorrelation(ComparisonMetric):
    """Lip PCC of the speed: do the lips move fast when the truth's do?

    With m[t] = mean_{v∈M} ‖x[t, v] − x[t − 1, v]‖₂, t from the second frame on, Pearson's correlation
    over frames between m_g and m_p in each sequence; then the mean over sequences. From −1 to 1, without unit.
    A template cancels. A prediction that does not vary counts 0; where the truth does not vary, or has fewer
    than three frames, the sequence is left out and `coverage` says so.

    Args:
        lips: Lip vertices, a `Region` or indices.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    higher_is_better = True
    leaves_out = "the speed of the truth's lips does not vary"
    indices: Tensor

    def __init__(
        self, lips: RegionLike, *, length_rule: LengthRule = "min", check_finite: bool = True, **kwargs: object
    ) -> None:
        region = as_region(lips, "lips")
        super().__init__(
            definition=f"in each sequence the Pearson correlation over frames between the mean speeds of {region}; "
            f"mean over sequences; {_RULE} [1]",
            pooling="sequences",
            region=region,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The correlation of one sequence, NaN if the truth's speed does not vary."""
        return correlation(speed(clip.truth, self.indices), speed(clip.prediction, self.indices))


def lip_opening_correlation(
    prediction: Tensor,
    truth: Tensor,
    pairs: LipPairsLike,
    *,
    offsets_from: Tensor | None = None,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Lip PCC: Pearson correlation over frames of the mouth's openings, see `LipOpeningCorrelation`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        offsets_from: Neutral vertices that prediction and truth are offsets from; None if they are absolute.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar, −1 to 1.

    Raises:
        ValueError: As `OpeningMetric.update`, and if no truth varies.

    >>> import torch
    >>> truth = torch.tensor([0.0, 1.0, 0.0, 2.0])[:, None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])
    >>> lip_opening_correlation(0.5 * truth, truth, [(0, 1)]).item()
    1.0
    """
    metric = LipOpeningCorrelation(pairs, length_rule=length_rule, sync_on_compute=False).to(truth.device)
    metric.update(
        prediction,
        truth,
        offsets_from=offsets_from,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()


def lip_speed_correlation(
    prediction: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Lip PCC: Pearson correlation over frames of the lips' mean speeds, see `LipSpeedCorrelation`.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        lips: Lip vertices, a `Region` or indices.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar, −1 to 1.

    Raises:
        ValueError: As `LipSpeedCorrelation.update`, and if no truth varies.
    """
    metric = LipSpeedCorrelation(lips, length_rule=length_rule, sync_on_compute=False).to(truth.device)
    metric.update(prediction, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()
