"""Face dynamics deviation as a metric that accumulates over batches."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from facediff.metrics.base import ComparisonMetric
from facediff.metrics.clips import Clip, Clips, Lengths, align
from facediff.metrics.formulas import dynamics_deviation
from facediff.metrics.options import SIGNS, LengthRule, Sign, check_option, dynamics_words
from facediff.metrics.regions import RegionLike, as_region


class FaceDynamicsDeviation(ComparisonMetric):
    r"""Face dynamics deviation (FDD): how much the upper face varies over time, truth against prediction.

    Per sequence d = mean_{v∈U} std_t ‖g − τ‖² − mean_{v∈U} std_t ‖p − τ‖² with truth g, prediction p, the
    subject's neutral template τ and the population standard deviation (ddof 0); FDD is the mean over
    sequences of d (``"signed"``: CodeTalker's script; sequences of opposite sign cancel) or of \|d\|
    (``"absolute"``: FaceDiffuser's second figure). The score is in the vertices' unit squared. Sequences
    count alike whatever their length; a sequence of one frame does not vary and gives 0.

    Args:
        upper: Upper-face vertices, a `Region` or indices.
        sign: ``"signed"`` or ``"absolute"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: If an option is unknown.

    >>> import torch
    >>> truth = torch.zeros(2, 1, 3)
    >>> truth[1] = 2.0  # the squared offset is 0, then 12: its standard deviation is 6
    >>> metric = FaceDynamicsDeviation([0], sign="signed")
    >>> metric.update(torch.zeros(2, 1, 3), truth)
    >>> metric.compute().item()
    6.0
    """

    # No higher_is_better: a signed deviation is best at zero.
    indices: Tensor

    def __init__(
        self,
        upper: RegionLike,
        *,
        sign: Sign = "absolute",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("sign", sign, SIGNS)
        region = as_region(upper, "upper")
        super().__init__(
            definition=dynamics_words(str(region), sign=sign),
            pooling="sequences",
            region=region,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.sign: Sign = sign

    def clip_value(self, clip: Clip) -> Tensor:
        """The deviation of one sequence."""
        value = dynamics_deviation(clip.prediction, clip.truth, clip.template, self.indices)
        return value if self.sign == "signed" else value.abs()

    def update(
        self,
        prediction: Tensor,
        truth: Tensor,
        *,
        template: Tensor | None = None,
        lengths: Lengths | None = None,
        prediction_lengths: Lengths | None = None,
        clip_names: Sequence[str] | None = None,
    ) -> None:
        """Add a batch of sequences.

        Args:
            prediction: (batch, frames, vertices, 3) or one sequence (frames, vertices, 3), floating point.
            truth: Likewise.
            template: Neutral vertices (batch, vertices, 3), or (vertices, 3) for all sequences, when
                prediction and truth are absolute vertices. **None means that they are offsets from the
                template already**; absolute vertices without a template give another, meaningless number.
            lengths: As for `ComparisonMetric.update`.
            prediction_lengths: As for `ComparisonMetric.update`.
            clip_names: One name a sequence, for messages.

        Raises:
            ValueError: As for `ComparisonMetric.update`, and if the template does not fit. Nothing is added
                then.
        """
        clips = align(
            prediction,
            truth,
            lengths=lengths,
            prediction_lengths=prediction_lengths,
            clip_names=clip_names,
            rule=self.length_rule,
        )
        self._add(clips.with_templates(split_template(template, clips)))


def split_template(template: Tensor | None, clips: Clips, name: str = "template") -> list[Tensor | None]:
    """One template (vertices, 3) for each sequence, or None for each.

    Args:
        template: (batch, vertices, 3), (vertices, 3) or None.
        clips: The sequences.
        name: What the caller calls it.

    Raises:
        ValueError: If the shape does not fit or the template holds NaN or infinity.
    """
    batch, vertices = len(clips.clips), clips.n_vertices
    if template is None:
        return [None] * batch
    if template.shape not in ((batch, vertices, 3), (vertices, 3)):
        raise ValueError(
            f"{name} has shape {tuple(template.shape)}; expected {(batch, vertices, 3)} or {(vertices, 3)}"
        )
    template = template.detach()
    each = list(template) if template.ndim == 3 else [template] * batch
    if not bool(template.isfinite().all()):
        bad = next(clip for clip, still in zip(clips.clips, each, strict=True) if not still.isfinite().all())
        raise ValueError(f"the template of {bad.name} holds NaN or infinity; repair or leave out this clip")
    return list(each)
