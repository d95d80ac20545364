"""Vertex errors and dynamics of one sequence from a single pass over its frames: the fast form of the formulas.

The definitions stand in the docstrings of :mod:`facediff.metrics.vertex_errors`, against which this is tested. A
sequence is larger than a processor's cache, and reading it from memory costs as much as some arithmetic on it. So a few
frames at a time are widened to float64 in buffers that are used again, and all that is asked for is taken from them
before the next frames are read.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from torch import Tensor

from facediff.metrics.base import Reduction

# Coordinates widened to float64 at a time: on a CPU few enough to stay near it, and enough that threads seldom wait for
# one another to start the next operation; on other devices many enough that starting the work costs nothing.
_CHUNK_CPU = 2**19
_CHUNK_ELSEWHERE = 2**24


@dataclass(frozen=True)
class ErrorOf:
    """Which vertex error to take: over which vertices (None for all), how reduced in a frame, and whether squared."""

    indices: Tensor | None
    reduction: Reduction
    squared: bool


@torch.no_grad()
def one_pass(
    prediction: Tensor,
    truth: Tensor,
    *,
    errors: Sequence[ErrorOf] = (),
    template: Tensor | None = None,
    uppers: Sequence[Tensor] = (),
) -> tuple[list[Tensor], list[Tensor]]:
    """Vertex errors, and how much less the prediction varies over time than the truth; float64 scalars.

    For each of ``errors`` its mean over frames, and for each of ``uppers``, (region,) int64, the signed deviation; for
    these a ``template`` (points, dims) is given unless prediction and truth (frames, points, dims) are offsets from it.
    Each result is the same alone and beside others: each vertex goes through the same float64 operations.
    """
    frames, vertices, _ = truth.shape
    regions = [*(error.indices for error in errors), *uppers]
    only = regions[0] if len(regions) == 1 else None
    step = frames_per_step(truth, vertices if only is None else len(only))
    buffers = Buffers(truth.device)
    everywhere = any(error.indices is None for error in errors)
    totals = torch.zeros(len(errors), dtype=torch.float64, device=truth.device)
    deviations = [
        tuple(Variation(motion[0], template, indices, step, buffers) for motion in (truth, prediction))
        for indices in uppers
    ]
    for start in range(0, frames, step):
        true, predicted = truth[start : start + step], prediction[start : start + step]
        all_squares = squared_errors(true, predicted, buffers) if everywhere else None
        for row, error in enumerate(errors):
            totals[row] += _sum_over_frames(error, all_squares, true, predicted, buffers)
        for of_truth, of_prediction in deviations:
            of_truth.add(true)
            of_prediction.add(predicted)
    means = list((totals / frames).unbind()) if errors else []
    return means, [of_truth.mean(frames) - of_prediction.mean(frames) for of_truth, of_prediction in deviations]


def frames_per_step(motion: Tensor, looked_at: int) -> int:
    """How many frames of so many vertices to widen at a time."""
    return max(1, (_CHUNK_CPU if motion.device.type == "cpu" else _CHUNK_ELSEWHERE) // (motion.shape[-1] * looked_at))


class Buffers:
    """Memory that is used again for every few frames: fresh memory would cost more than the arithmetic on it."""

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self.kept: dict[tuple[str, torch.dtype], Tensor] = {}

    def get(self, name: str, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
        """Memory of that shape, with anything in it; the same for the same name and type."""
        size = math.prod(shape)
        buffer = self.kept.get((name, dtype))
        if buffer is None or len(buffer) < size:
            buffer = self.kept[name, dtype] = torch.empty(size, dtype=dtype, device=self.device)
        return buffer[:size].view(shape)


def widened(motion: Tensor, name: str, buffers: Buffers) -> Tensor:
    """The same in float64: itself if it is so already, else in a buffer of that name."""
    if motion.dtype == torch.float64:
        return motion
    return buffers.get(name, *motion.shape).copy_(motion)


def squared_errors(true: Tensor, predicted: Tensor, buffers: Buffers) -> Tensor:
    """Σ_c (g_c − p_c)² of every point, (frames, points) float64, in a buffer."""
    difference = buffers.get("difference", *true.shape)
    torch.sub(widened(true, "difference", buffers), widened(predicted, "predicted", buffers), out=difference)
    difference.mul_(difference)
    # Three strided terms are much faster than a reduction of length three.
    first, *rest = difference.unbind(-1)
    errors = buffers.get("errors", *first.shape)
    if not rest:
        return errors.copy_(first)
    torch.add(first, rest[0], out=errors)
    for term in rest[1:]:
        errors.add_(term)
    return errors


def _sum_over_frames(
    error: ErrorOf, all_squares: Tensor | None, true: Tensor, predicted: Tensor, buffers: Buffers
) -> Tensor:
    """The error of each frame, added up; from the squared errors of all vertices if there are any."""
    if all_squares is None:
        region = cast(Tensor, error.indices)
        squares = squared_errors(true.index_select(1, region), predicted.index_select(1, region), buffers)
    else:
        squares = all_squares if error.indices is None else all_squares.index_select(1, error.indices)
    if error.reduction == "max":
        largest = squares.amax(1)  # before the root: the root is monotone, and taken once a frame
        return (largest if error.squared else largest.sqrt()).sum()
    roots = squares if error.squared else torch.sqrt(squares, out=buffers.get("roots", *squares.shape))
    return roots.sum() / squares.shape[1]


def squared_norm(vectors: Tensor) -> Tensor:
    """Σ_c v_c² over the last axis; three strided terms are much faster than a reduction of length three."""
    first, *rest = vectors.square().unbind(-1)
    return sum(rest, first)


class Variation:
    """Mean over vertices of the population standard deviation over time of the squared offset.

    Sums of q − q₀ and of its square, q₀ being the squared offset in the first frame, are all that is kept. As q₀ is one
    of the n values, (mean − q₀)² is at most n times the variance, so that subtracting the one sum from the other loses
    no more than log₁₀ n + 1 of float64's digits. At most ``step`` frames are added in one call.
    """

    def __init__(self, first: Tensor, template: Tensor | None, indices: Tensor, step: int, buffers: Buffers) -> None:
        # All x, then all y, then all z: terms that are adjacent in memory are added much faster than strided ones.
        self.dims = first.shape[-1]
        self.places = (self.dims * indices + torch.arange(self.dims, device=indices.device)[:, None]).flatten()
        self.still = None if template is None else template.reshape(-1).index_select(0, self.places).double()
        self.buffers = buffers
        self.count = len(indices)
        self.first = self._squared_offsets(first[None])[0].clone()
        self.sums = torch.zeros(step, self.count, dtype=torch.float64, device=first.device)
        self.squares = torch.zeros_like(self.sums)

    def add(self, motion: Tensor) -> None:
        """Add frames (frames, points, dims)."""
        moved = self._squared_offsets(motion).sub_(self.first)
        self.sums[: len(motion)].add_(moved)
        self.squares[: len(motion)].addcmul_(moved, moved)

    def mean(self, frames: int) -> Tensor:
        """The mean over vertices, float64 scalar, once so many frames have been added."""
        variance = (self.squares.sum(0) - self.sums.sum(0).square() / frames) / frames
        return variance.clamp(min=0).sqrt().mean()

    def _squared_offsets(self, motion: Tensor) -> Tensor:
        """(frames, region), in a buffer."""
        offsets = self.buffers.get("chosen", len(motion), self.dims * self.count, dtype=motion.dtype)
        torch.index_select(motion.reshape(len(motion), -1), 1, self.places, out=offsets)
        offset = widened(offsets, "offset", self.buffers)
        if self.still is not None:
            offset.sub_(self.still)
        first, *rest = offset.view(len(motion), self.dims, self.count).unbind(1)
        squared = torch.mul(first, first, out=self.buffers.get("squared", len(motion), self.count))
        for term in rest:
            squared.addcmul_(term, term)
        return squared
