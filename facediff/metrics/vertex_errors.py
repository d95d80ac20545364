"""Mean vertex error and lip vertex error as metrics that accumulate over batches."""

from __future__ import annotations

from torch import Tensor

from facediff.metrics.base import ComparisonMetric
from facediff.metrics.clips import Clip
from facediff.metrics.formulas import vertex_error
from facediff.metrics.one_pass import ErrorOf
from facediff.metrics.options import (
    POOLINGS,
    REDUCTIONS,
    LengthRule,
    Pooling,
    Reduction,
    check_option,
    vertex_error_words,
)
from facediff.metrics.regions import RegionLike, as_region


class VertexError(ComparisonMetric):
    """Distance between predicted and true vertices, over a region or the whole mesh.

    With e²[t, v] = Σ_c (g[t, v, c] − p[t, v, c])² of truth g and prediction p, each frame gives the mean or
    the maximum over v of e² (squared) or √e²; frames are then pooled. Absolute vertices and offsets from the
    template give the same number, since the template cancels.

    Args:
        region: Vertices to look at, a `Region` or indices; None for all.
        reduction: ``"mean"`` or ``"max"`` over the vertices of a frame.
        squared: Whether distances are squared; the score is then in the vertices' unit squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    Raises:
        ValueError: If an option is unknown.
    """

    higher_is_better = False

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        reduction: Reduction = "mean",
        squared: bool = False,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        check_option("reduction", reduction, REDUCTIONS)
        check_option("pooling", pooling, POOLINGS)
        named = None if region is None else as_region(region, "vertices")
        where = "all vertices" if named is None else str(named)
        super().__init__(
            definition=vertex_error_words(where, reduction=reduction, squared=squared, pooling=pooling),
            pooling=pooling,
            region=named,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
        self.reduction: Reduction = reduction
        self.squared = squared

    def wanted(self) -> ErrorOf:
        """The error, as `facediff.metrics.one_pass.one_pass` is asked for it."""
        return ErrorOf(self.indices, self.reduction, self.squared)

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of one sequence, mean over its frames."""
        return vertex_error(clip.prediction, clip.truth, self.indices, reduction=self.reduction, squared=self.squared)


class MeanVertexError(VertexError):
    """Mean vertex error (MVE) over the whole mesh.

    ``reduction="mean"``, unsquared, pooled by frames is FaceDiffuser's script: mean over frames and vertices
    of √e². ``reduction="max"`` is the text of the dual-path style diffusion paper: the largest √e² of each
    frame, averaged over frames.

    Args:
        reduction: ``"mean"`` or ``"max"`` over the vertices of a frame.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    >>> import torch
    >>> metric = MeanVertexError()
    >>> metric.update(torch.ones(2, 5, 7, 3), torch.zeros(2, 5, 7, 3), lengths=[5, 4])
    >>> round(metric.compute().item(), 6), metric.coverage().frames
    (1.732051, 9)
    """

    def __init__(
        self,
        *,
        reduction: Reduction = "mean",
        squared: bool = False,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            None,
            reduction=reduction,
            squared=squared,
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )


class LipVertexError(VertexError):
    """Lip vertex error (LVE): the largest error among the lip vertices of each frame, averaged.

    Squared and pooled by frames is what CodeTalker's and FaceDiffuser's scripts compute (unit squared);
    unsquared is MeshTalk's paper; squared and pooled by sequences is what DiffSpeaker's code reports.

    Args:
        lips: Lip vertices, a `Region` or indices.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.

    >>> import torch
    >>> metric = LipVertexError([1, 2])
    >>> metric.update(torch.ones(4, 3, 3), torch.zeros(4, 3, 3))
    >>> metric.compute().item()
    3.0
    """

    def __init__(
        self,
        lips: RegionLike,
        *,
        squared: bool = True,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            as_region(lips, "lips"),
            reduction="max",
            squared=squared,
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )


class UpperFaceVertexError(VertexError):
    """Upper-face vertex error (UVE): how far the vertices of the upper face are from the truth.

    The mean over frames of the mean (or largest) distance √e² over the upper-face vertices: what MVE is for
    the whole mesh. There is no usual formula of that name; the mean of unsquared distances is a choice, and
    ``reduction="max", squared=True`` is what LVE's formula gives on this region. Unlike FDD it tells a brow
    that moves at the wrong moment from one that moves rightly, and so counts against a face whose upper part
    is plausible but not the truth's.

    Args:
        upper: Upper-face vertices, a `Region` or indices.
        reduction: ``"mean"`` or ``"max"`` over the vertices of a frame.
        squared: Whether distances are squared.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        check_finite: Whether NaN and infinity are refused.
        **kwargs: For `torchmetrics.Metric`.
    """

    def __init__(
        self,
        upper: RegionLike,
        *,
        reduction: Reduction = "mean",
        squared: bool = False,
        pooling: Pooling = "frames",
        length_rule: LengthRule = "min",
        check_finite: bool = True,
        **kwargs: object,
    ) -> None:
        super().__init__(
            as_region(upper, "upper"),
            reduction=reduction,
            squared=squared,
            pooling=pooling,
            length_rule=length_rule,
            check_finite=check_finite,
            **kwargs,
        )
