"""The formulas themselves: one sequence, prediction and truth (frames, vertices, 3), to one number.

All arithmetic is in float64 whatever comes in: a deviation is a small difference of large numbers.
"""

from __future__ import annotations

import torch
from torch import Tensor

from facediff.metrics.one_pass import ErrorOf, one_pass, steps
from facediff.metrics.options import Reduction


def vertex_error(
    prediction: Tensor, truth: Tensor, indices: Tensor | None, *, reduction: Reduction, squared: bool
) -> Tensor:
    """Mean over frames of the mean or largest vertex distance of each frame.

    Args:
        prediction: (frames, vertices, 3).
        truth: (frames, vertices, 3).
        indices: Vertices to look at, (region,) int64; None for all.
        reduction: How the vertices of a frame become one number.
        squared: Whether distances are squared.

    Returns:
        Scalar, float64.
    """
    return one_pass(prediction, truth, errors=[ErrorOf(indices, reduction, squared)])[0][0]


def dynamics_deviation(prediction: Tensor, truth: Tensor, template: Tensor | None, indices: Tensor) -> Tensor:
    """How much less the prediction varies over time than the truth, signed.

    Args:
        prediction: (frames, vertices, 3).
        truth: (frames, vertices, 3).
        template: (vertices, 3), or None if prediction and truth are offsets from it already.
        indices: Vertices to look at, (region,) int64.

    Returns:
        Scalar, float64; positive if the prediction moves less.
    """
    return one_pass(prediction, truth, template=template, uppers=[indices])[1][0]


def opening(motion: Tensor, offsets_from: Tensor | None, pairs: Tensor) -> Tensor:
    """How far the mouth is open in each frame: the mean distance of the lip pairs.

    Args:
        motion: (frames, vertices, 3).
        offsets_from: (vertices, 3) that ``motion`` is offsets from; None if it is absolute vertices.
        pairs: (pairs, 2) int64, an upper and a lower vertex each.

    Returns:
        (frames,), float64, in the vertices' unit.
    """
    gap = motion.index_select(1, pairs[:, 0]).double() - motion.index_select(1, pairs[:, 1]).double()
    if offsets_from is not None:
        gap = gap + (offsets_from.index_select(0, pairs[:, 0]).double() - offsets_from.index_select(0, pairs[:, 1]))
    return _squared_norm(gap).sqrt().mean(1)


def speed(motion: Tensor, indices: Tensor) -> Tensor:
    """How far the vertices move from each frame to the next, mean over the vertices.

    Args:
        motion: (frames, vertices, 3); a template would cancel.
        indices: Vertices to look at, (region,) int64.

    Returns:
        (frames − 1,), float64, in the vertices' unit for each frame.
    """
    frames = len(motion)
    out = torch.zeros(frames - 1, dtype=torch.float64, device=motion.device)
    step = steps(motion, len(indices))
    for start in range(0, frames - 1, step):
        some = motion[start : start + step + 1].index_select(1, indices).double()
        out[start : start + step] = _squared_norm(some[1:] - some[:-1]).sqrt().mean(1)
    return out


def correlation(reference: Tensor, other: Tensor) -> Tensor:
    """Pearson's correlation coefficient of two series of equal length.

    A series varies if its range exceeds 1e-12 of its largest absolute value, which rounding alone does not
    reach.

    Args:
        reference: (frames,) float64, what is to be followed.
        other: (frames,) float64, what should follow it.

    Returns:
        Scalar, float64; 0 where ``other`` does not vary, NaN where ``reference`` does not.
    """
    if len(reference) < 2:
        return torch.full((), torch.nan, dtype=torch.float64, device=reference.device)
    first, second = reference - reference.mean(), other - other.mean()
    scale = (first.square().sum() * second.square().sum()).sqrt()
    found = ((first * second).sum() / scale).clamp(-1, 1)
    return torch.where(_steady(reference), torch.nan, torch.where(_steady(other), 0.0, found))


def _steady(series: Tensor) -> Tensor:
    low, high = series.aminmax()
    return high - low <= 1e-12 * torch.maximum(high.abs(), low.abs())


def _squared_norm(vectors: Tensor) -> Tensor:
    """Σ_c v_c² over the last axis; three strided terms are much faster than a reduction of length three."""
    x, y, z = vectors.square().unbind(-1)
    return x + y + z
