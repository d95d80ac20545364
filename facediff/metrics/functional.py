"""MVE, LVE, UVE and FDD as functions of one sequence or one padded batch.

They, and the functions beside the other metrics' classes, are the classes used once, so that both give the
same number by construction. Inputs and errors are those of the classes' ``update``; an empty batch is a
ValueError. Processes are not brought together.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from facediff.metrics.clips import Lengths
from facediff.metrics.face_dynamics import FaceDynamicsDeviation
from facediff.metrics.options import LengthRule, Pooling, Reduction, Sign
from facediff.metrics.regions import RegionLike
from facediff.metrics.vertex_errors import LipVertexError, MeanVertexError, UpperFaceVertexError


def mean_vertex_error(
    prediction: Tensor,
    truth: Tensor,
    *,
    reduction: Reduction = "mean",
    squared: bool = False,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Mean vertex error (MVE): mean over frames of the mean or largest √e² over all vertices.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        reduction: ``"mean"`` (FaceDiffuser's script) or ``"max"`` (text of the dual-path style diffusion
            paper).
        squared: Whether e² replaces √e².
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit, squared if ``squared``.

    Raises:
        ValueError: As `MeanVertexError.update`.

    >>> import torch
    >>> mean_vertex_error(torch.ones(4, 3, 3), torch.zeros(4, 3, 3), squared=True).item()
    3.0
    """
    metric = MeanVertexError(
        reduction=reduction, squared=squared, pooling=pooling, length_rule=length_rule, sync_on_compute=False
    ).to(truth.device)
    metric.update(prediction, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def lip_vertex_error(
    prediction: Tensor,
    truth: Tensor,
    lips: RegionLike,
    *,
    squared: bool = True,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Lip vertex error (LVE): mean over frames of the largest e² (or √e²) among the lip vertices.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        lips: Lip vertices, a `Region` or indices.
        squared: True as in the released scripts (CodeTalker, FaceDiffuser), False as in MeshTalk's paper.
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit squared, or in the unit if not ``squared``.

    Raises:
        ValueError: As `LipVertexError.update`.

    >>> import torch
    >>> lip_vertex_error(torch.ones(4, 3, 3), torch.zeros(4, 3, 3), [0, 2]).item()
    3.0
    """
    metric = LipVertexError(lips, squared=squared, pooling=pooling, length_rule=length_rule, sync_on_compute=False).to(
        truth.device
    )
    metric.update(prediction, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def upper_face_vertex_error(
    prediction: Tensor,
    truth: Tensor,
    upper: RegionLike,
    *,
    reduction: Reduction = "mean",
    squared: bool = False,
    pooling: Pooling = "frames",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Upper-face vertex error (UVE): mean over frames of the mean or largest √e² over the upper face.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        upper: Upper-face vertices, a `Region` or indices.
        reduction: ``"mean"`` or ``"max"``.
        squared: Whether e² replaces √e².
        pooling: ``"frames"`` or ``"sequences"``.
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit, squared if ``squared``.

    Raises:
        ValueError: As `UpperFaceVertexError.update`.

    >>> import torch
    >>> upper_face_vertex_error(torch.ones(4, 3, 3), torch.zeros(4, 3, 3), [0, 2], squared=True).item()
    3.0
    """
    metric = UpperFaceVertexError(
        upper,
        reduction=reduction,
        squared=squared,
        pooling=pooling,
        length_rule=length_rule,
        sync_on_compute=False,
    ).to(truth.device)
    metric.update(prediction, truth, lengths=lengths, prediction_lengths=prediction_lengths, clip_names=clip_names)
    return metric.compute()


def face_dynamics_deviation(
    prediction: Tensor,
    truth: Tensor,
    upper: RegionLike,
    *,
    template: Tensor | None = None,
    sign: Sign = "absolute",
    length_rule: LengthRule = "min",
    lengths: Lengths | None = None,
    prediction_lengths: Lengths | None = None,
    clip_names: Sequence[str] | None = None,
) -> Tensor:
    """Face dynamics deviation (FDD): mean_{v∈U} std_t ‖g−τ‖² − mean_{v∈U} std_t ‖p−τ‖², mean over sequences.

    Args:
        prediction: (batch, frames, vertices, 3) or (frames, vertices, 3).
        truth: Likewise.
        upper: Upper-face vertices, a `Region` or indices.
        template: τ, (batch, vertices, 3) or (vertices, 3). None means that prediction and truth are offsets
            from the template already.
        sign: ``"signed"`` (CodeTalker's script) or ``"absolute"`` in each sequence (FaceDiffuser's second
            figure).
        length_rule: ``"min"``, ``"error"`` or ``"prediction"``.
        lengths: Valid frames (batch,) or mask (batch, frames), of both sides unless the next is given.
        prediction_lengths: Valid frames of the prediction.
        clip_names: One name a sequence, for messages.

    Returns:
        Float64 scalar in the vertices' unit squared; signed, it is positive where the prediction moves less.

    Raises:
        ValueError: As `FaceDynamicsDeviation.update`.

    >>> import torch
    >>> face_dynamics_deviation(torch.zeros(4, 3, 3), torch.ones(4, 3, 3), [0, 2]).item()  # both still
    0.0
    """
    metric = FaceDynamicsDeviation(upper, sign=sign, length_rule=length_rule, sync_on_compute=False).to(truth.device)
    metric.update(
        prediction,
        truth,
        template=template,
        lengths=lengths,
        prediction_lengths=prediction_lengths,
        clip_names=clip_names,
    )
    return metric.compute()
