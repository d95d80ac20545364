"""The formulas themselves: one sequence, prediction and truth (frames, vertices, 3), to one number.

All arithmetic is in float64 whatever comes in: a deviation is a small difference of large numbers.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from facediff.metrics.clips import Clips
from facediff.metrics.options import Pooling, Reduction

# Coordinates widened to float64 at a time: on a CPU few enough to stay in its cache (five times the speed of
# whole sequences), on other devices many enough that starting the work costs nothing.
_CHUNK_CPU = 2**18
_CHUNK_ELSEWHERE = 2**24


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
    frames, vertices, _ = truth.shape
    looked_at = vertices if indices is None else len(indices)
    step = max(1, _chunk(truth) // (3 * looked_at))
    total = torch.zeros((), dtype=torch.float64, device=truth.device)
    for start in range(0, frames, step):
        true, predicted = truth[start : start + step], prediction[start : start + step]
        if indices is not None:
            true, predicted = true.index_select(1, indices), predicted.index_select(1, indices)
        error = _squared_norm(true.double() - predicted.double())
        if reduction == "max":
            frame_errors = error.amax(1)  # before the root: the root is monotone, and taken once a frame
            total += (frame_errors if squared else frame_errors.sqrt()).sum()
        else:
            total += (error if squared else error.sqrt()).mean(1).sum()
    return total / frames


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
    return _variation(truth, template, indices) - _variation(prediction, template, indices)


def pool(values: Sequence[Tensor], clips: Clips, pooling: Pooling) -> Tensor:
    """Sum of the sequences' values, each weighted by its frames if pooling by frames; float64 scalar."""
    weights = [clip.frames if pooling == "frames" else 1 for clip in clips.clips]
    stacked = torch.stack(list(values))
    return (stacked * torch.tensor(weights, dtype=torch.float64, device=stacked.device)).sum()


def _variation(motion: Tensor, template: Tensor | None, indices: Tensor) -> Tensor:
    """Mean over vertices of the population standard deviation over time of the squared offset."""
    total = torch.zeros((), dtype=torch.float64, device=motion.device)
    step = max(1, _chunk(motion) // (3 * len(motion)))
    for start in range(0, len(indices), step):
        some = indices[start : start + step]
        offset = motion.index_select(1, some).double()
        if template is not None:
            offset = offset - template.index_select(0, some).double()
        total += _squared_norm(offset).std(0, correction=0).sum()
    return total / len(indices)


def _chunk(motion: Tensor) -> int:
    return _CHUNK_CPU if motion.device.type == "cpu" else _CHUNK_ELSEWHERE


def _squared_norm(vectors: Tensor) -> Tensor:
    """Σ_c v_c² over the last axis; three strided terms are much faster than a reduction of length three."""
    x, y, z = vectors.square().unbind(-1)
    return x + y + z
