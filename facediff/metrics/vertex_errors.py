"""Distance of the vertices from the truth (MVE, LVE), and how much the upper face moves (FDD).

g and p are truth and prediction (frames, vertices, 3), and e²[t, v] = Σ_c (g[t, v, c] − p[t, v, c])². The arithmetic,
in float64 and in one pass over the frames, is in :mod:`facediff.metrics.one_pass`.
"""

from __future__ import annotations

from typing import Unpack

from torch import Tensor

from facediff.metrics.base import (
    Clip,
    Pooling,
    Reduction,
    SequenceMetric,
    SequenceOptions,
    Sign,
    UpdateOptions,
    check_option,
    check_range,
    functional,
)
from facediff.metrics.one_pass import ErrorOf, one_pass
from facediff.metrics.regions import RegionLike, as_region
from facediff.registry import metric


def vertex_error_words(*, reduction: Reduction, squared: bool, root: bool = False, scale: float = 1.0) -> str:
    """The definition of a vertex error in plain words, in which region and pooling are still to be filled in."""
    distance = "squared distance" if squared else "distance"
    which = "mean" if reduction == "mean" else "largest"
    rooted = ", and the root of each sequence's mean" if root else ""
    unit = _unit_words(scale, squared=squared and not root)
    return f"in each frame the {which} {distance} over {{region}}{rooted}; {{pooling}} [{unit}]"


def _unit_words(scale: float, *, squared: bool) -> str:
    unit = "unit²" if squared else "unit"
    return unit if scale == 1.0 else f"{unit} of lengths times {scale:g}"


class VertexOptions(SequenceOptions, total=False):
    """Options of every vertex error; see :class:`VertexError`."""

    pooling: Pooling
    root: bool
    scale: float


class VertexError(SequenceMetric):
    """Distance between predicted and true vertices, over a region or the whole mesh.

    Each frame gives the mean or the maximum over v of e² (squared) or √e²; frames are then pooled. Absolute vertices
    and offsets from the template give the same number, since the template cancels.

    Args:
        region: vertices to look at, a :class:`Region` or indices; None for all.
        reduction: ``"mean"`` or ``"max"`` over the vertices of a frame.
        squared: whether distances are squared, e² instead of √e²; the score is then in the vertices' unit squared.
        root: take the root of each sequence's mean over frames, so that a squared error is in the vertices' unit.
        scale: factor of all lengths: 1000 gives millimetres where vertices are in metres.
    """

    higher_is_better = False

    def __init__(
        self,
        region: RegionLike | None = None,
        *,
        reduction: Reduction = "mean",
        squared: bool = False,
        pooling: Pooling = "frames",
        root: bool = False,
        scale: float = 1.0,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("reduction", reduction, Reduction)
        check_range("scale", scale, 1e-12)
        if root and not squared:
            raise ValueError("root is of squared distances; give squared too")
        definition = vertex_error_words(reduction=reduction, squared=squared, root=root, scale=scale)
        super().__init__(definition=definition, pooling=pooling, region=region, **options)
        self.reduction: Reduction = reduction
        self.squared = squared
        self.root = root
        self.scale = scale

    def error_of(self) -> ErrorOf:
        """The error for :func:`facediff.metrics.one_pass.one_pass`."""
        return ErrorOf(self.indices, self.reduction, self.squared)

    def clip_value(self, clip: Clip) -> Tensor:
        """The error of one sequence, mean over its frames."""
        return self.finished(one_pass(clip.prediction, clip.truth, errors=[self.error_of()])[0][0])

    def finished(self, error: Tensor) -> Tensor:
        """The error of one sequence from its mean over frames: its root, where asked for, in the unit asked for."""
        return error.sqrt() * self.scale if self.root else error * self.scale ** (2 if self.squared else 1)


@metric.register("mean_vertex_error")
class MeanVertexError(VertexError):
    """Mean vertex error (MVE): mean over frames of the mean or largest √e² over all vertices, or those of a region.

    ``reduction="mean"``, unsquared, pooled by frames is FaceDiffuser's script: mean over frames and vertices
    of √e². ``reduction="max"`` is the text of the dual-path style diffusion paper: the largest √e² of each
    frame, averaged over frames. In the vertices' unit, squared if ``squared``. Squared with ``root`` it is what ARTalk
    and UniLS call MHD. Over the upper face it counts, unlike FDD, a brow that moves at the wrong moment.

    >>> import torch
    >>> metric = MeanVertexError()
    >>> metric.update(torch.ones(2, 5, 7, 3), torch.zeros(2, 5, 7, 3), lengths=[5, 4])
    >>> round(metric.compute().item(), 6), metric.coverage().frames
    (1.732051, 9)
    """


mean_vertex_error = functional(MeanVertexError)


@metric.register("lip_vertex_error")
class LipVertexError(VertexError):
    """Lip vertex error (LVE): the largest error among the lip vertices of each frame, averaged.

    Squared and pooled by frames is what CodeTalker's and FaceDiffuser's scripts compute (unit squared);
    unsquared is MeshTalk's paper; squared and pooled by sequences is what DiffSpeaker's code reports; squared with
    ``root``, pooled by sequences, in millimetres is the one of ARTalk and UniLS.

    Args:
        lips: lip vertices, a :class:`Region` or indices.

    >>> import torch
    >>> metric = LipVertexError([1, 2])
    >>> metric.update(torch.ones(4, 3, 3), torch.zeros(4, 3, 3))
    >>> metric.compute().item()
    3.0
    >>> lip_vertex_error(torch.ones(4, 3, 3), torch.zeros(4, 3, 3), [0, 2], squared=True).item()
    3.0
    """

    needs = ("lips",)

    def __init__(self, lips: RegionLike, *, squared: bool = True, **options: Unpack[VertexOptions]) -> None:
        super().__init__(as_region(lips, "lips"), reduction="max", squared=squared, **options)


lip_vertex_error = functional(LipVertexError)


def dynamics_words(*, sign: Sign, scale: float = 1.0) -> str:
    """The definition of the face dynamics deviation in plain words, in which the region is still to be filled in."""
    sign_words = "signed, positive where the prediction moves less" if sign == "signed" else "its absolute value"
    return (
        "in each sequence the mean over {region} of the standard deviation over time (population) of the "
        f"squared offset from the template, truth minus prediction, {sign_words}; mean over sequences "
        f"[{_unit_words(scale, squared=True)}]"
    )


@metric.register("face_dynamics_deviation")
class FaceDynamicsDeviation(SequenceMetric):
    r"""Face dynamics deviation (FDD): how much the upper face varies over time, truth against prediction.

    Per sequence d = mean_{v∈U} std_t ‖g − τ‖² − mean_{v∈U} std_t ‖p − τ‖² with truth g, prediction p, the
    speaker's neutral template τ and the population standard deviation (ddof 0); FDD is the mean over
    sequences of d (``"signed"``: CodeTalker's script; sequences of opposite sign cancel) or of \|d\|
    (``"absolute"``: FaceDiffuser's second figure). The score is in the vertices' unit squared. Sequences
    count alike at any length; a sequence of one frame does not vary and gives 0.

    Args:
        upper: upper-face vertices, a :class:`Region` or indices.
        sign: ``"signed"`` or ``"absolute"`` in each sequence.
        scale: factor of all lengths: 1000 gives square millimetres where vertices are in metres.

    >>> import torch
    >>> truth = torch.zeros(2, 1, 3)
    >>> truth[1] = 2.0  # the squared offset is 0, then 12: its standard deviation is 6
    >>> metric = FaceDynamicsDeviation([0], sign="signed")
    >>> metric.update(torch.zeros(2, 1, 3), truth)
    >>> metric.compute().item()
    6.0
    """

    # No higher_is_better: a signed deviation is best at zero.
    needs = ("upper_face", "template")
    indices: Tensor

    def __init__(
        self,
        upper: RegionLike,
        *,
        sign: Sign = "absolute",
        scale: float = 1.0,
        **options: Unpack[SequenceOptions],
    ) -> None:
        check_option("sign", sign, Sign)
        check_range("scale", scale, 1e-12)
        words = dynamics_words(sign=sign, scale=scale)
        super().__init__(definition=words, region=as_region(upper, "upper"), **options)
        self.sign: Sign = sign
        self.scale = scale

    def clip_value(self, clip: Clip) -> Tensor:
        """The deviation of one sequence."""
        value = one_pass(clip.prediction, clip.truth, template=clip.template, uppers=[self.indices])[1][0]
        return self.finished(value)

    def finished(self, deviation: Tensor) -> Tensor:
        """The deviation of one sequence with the sign, and in the unit, asked for."""
        return (deviation if self.sign == "signed" else deviation.abs()) * self.scale**2

    def update(
        self, prediction: Tensor, truth: Tensor, *, template: Tensor | None = None, **batch: Unpack[UpdateOptions]
    ) -> None:
        """Add a batch of sequences; see :meth:`SequenceMetric.update`.

        ``template`` are the neutral vertices, (batch, vertices, 3) or (vertices, 3) for all sequences, of absolute
        prediction and truth. **None means that these are offsets from the template already**; absolute vertices without
        a template give a meaningless number.
        """
        self.add(self.align(prediction, truth, **batch).attach_templates(template))


face_dynamics_deviation = functional(FaceDynamicsDeviation)
