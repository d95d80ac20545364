"""The opening of the mouth: the base of metrics that read it, and the mouth-opening difference.

The opening of a frame is the mean distance of named pairs of inner-lip vertices. It needs absolute vertices:
of offsets alone the distance means nothing. So motion is taken as absolute unless ``offsets_from=`` gives the
neutral vertices that it is offset from. (FDD's ``template=`` is the other way round; the two have different
names so that a `torchmetrics.MetricCollection` can pass both.)
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from facediff.metrics.base import SequenceMetric
from facediff.metrics.clips import Clip, Lengths, align
from facediff.metrics.face_dynamics import split_template
from facediff.metrics.formulas import opening
from facediff.metrics.lip_pairs import LipPairsLike, as_lip_pairs
from facediff.metrics.options import POOLING_WORDS, POOLINGS, LengthRule, Pooling, check_option


class OpeningMetric(SequenceMetric):
    """Base of metrics that read the opening of the mouth.

    Args:
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        definition: The metric in words; ``{pairs}`` in it becomes the pairs' name, number and hash.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        definition: str,
        pooling: Pooling,
        length_rule: LengthRule,
        check_finite: bool,
        **kwargs: object,
    ) -> None:
        named = as_lip_pairs(pairs)
        super().__init__(
            definition=definition.format(pairs=named),
            pooling=pooling,
            region=None,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.pairs = named
        self.pair_indices: Tensor
        self.register_buffer("pair_indices", named.tensor(), persistent=False)

    def check_vertices(self, n_vertices: int) -> None:
        """Refuse motion of a mesh that the pairs cannot belong to."""
        self.pairs.check(n_vertices)

    def openings(self, clip: Clip) -> tuple[Tensor, Tensor]:
        """The mouth's opening in each frame of prediction and truth, (frames,) float64 each."""
        predicted, true = (
            opening(motion, clip.template, self.pair_indices) for motion in (clip.prediction, clip.truth)
        )
        return predicted, true

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        offsets_from: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: Likewise.
            offsets_from: Neutral vertices (batch, vertices, 3), or (vertices, 3) for all sequences, that
                prediction and truth are offsets from. **None means that they are absolute vertices**; offsets
                without it give another, meaningless number.
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: As for `ComparisonMetric.update`.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `ComparisonMetric.update`, and if ``offsets_from`` does not fit. Nothing is
                added then.
        """
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips.with_templates(split_template(offsets_from, clips, "offsets_from")))


class MouthOpeningDifference(OpeningMetric):
    r"""Mouth-opening difference (MOD): how far the openings of prediction and truth are apart.

    With o[t] = mean over the pairs (a, b) of ‖x[t, a] − x[t, b]‖₂, the mean over frames of
    \|o_g[t] − o_p[t]\|, in the vertices' unit.

    The definition is a choice. DiffPoseTalk's paper brought the name up and released no formula; other
    projects of that name compute the root mean square over frames of the difference between two landmarks
    (MSMD, by its authors' account), or the mean instead of the maximum of the lip vertex error (ARTalk, by its
    author's account). The numbers cannot be compared.

    Args:
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    >>> import torch
    >>> metric = MouthOpeningDifference([(0, 1)])
    >>> closed, ajar = torch.zeros(5, 2, 3), torch.zeros(5, 2, 3)
    >>> ajar[:, 0, 1] = 0.25
    >>> metric.update(closed, ajar)
    >>> metric.compute().item()
    0.25
    """

    higher_is_better = False

    def __init__(
        self,
        pairs: LipPairsLike,
        *,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("pooling", pooling, POOLINGS)
        super().__init__(
            pairs,
            definition="in each frame the difference between the openings of the mouth, an opening being the mean "
            f"distance of {{pairs}}; {POOLING_WORDS[pooling]} [unit]",
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )

    def clip_value(self, clip: Clip) -> Tensor:
        """The difference of one sequence, mean over its frames."""
        predicted, true = self.openings(clip)
        return (predicted - true).abs().mean()


def mouth_opening_difference(
    prediction: Tensor,
    truth: Tensor,
    pairs: LipPairsLike,
    *,
    offsets_from: Tensor | None = None,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    r"""Mouth-opening difference (MOD): mean over frames of \|o_g − o_p\|, o the mean distance of the pairs.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        pairs: Inner-lip vertex pairs, `LipPairs` or pairs of indices.
        offsets_from: Neutral vertices that prediction and truth are offsets from; None if they are absolute.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit.

    Raises:
        ValueError: As `OpeningMetric.update`.
    """
    metric = MouthOpeningDifference(pairs, pooling=pooling, length_rule=length_rule, sync_on_compute=False)
    metric = metric.to(truth.device)
    metric.update(
        prediction,
        truth,
        offsets_from=offsets_from,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
