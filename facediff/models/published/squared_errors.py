"""Squared errors of motion and of its changes, in few passes over the vertices.

The published losses are means over every coordinate of every frame, so that on a small model most of a training step is
reading and writing vertices. Written out, error, mask, square, difference and sum are passes of their own, and as many
again on the way back; here errors are kept once and their gradient is one pass.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from facediff.models.layers import frame_mask


def squared_errors(
    predicted: Float[Tensor, "batch frames coordinates"],
    truth: Float[Tensor, "batch frames coordinates"],
    frames: Int[Tensor, " batch"],
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Sums, over the valid frames, of Σ (x̂ − x)² and of Σ (Δx̂ − Δx)², with Δ the change since the frame before.

    Args:
        predicted: motion with gradient.
        truth: true motion in the same unit.
        frames: valid frames of each clip; both may hold anything after them.

    Returns:
        the sum over coordinates of all frames, and of the changes between neighbouring frames, of which each clip has
        one fewer.
    """
    position, change = _SquaredErrors.apply(predicted, truth, frame_mask(frames, predicted.shape[1])[..., None])  # type: ignore[no-untyped-call]
    return position, change


def mean_squared_error(
    predicted: Float[Tensor, "batch frames coordinates"],
    truth: Float[Tensor, "batch frames coordinates"],
    frames: Int[Tensor, " batch"],
) -> Float[Tensor, ""]:
    """The mean over all numbers of the valid frames: of one clip, PyTorch's own loss."""
    position, _ = squared_errors(predicted, truth, frames)
    return position / (frames.sum() * predicted.shape[2]).clamp_min(1)


class _SquaredErrors(torch.autograd.Function):
    """Both sums, with the masked error kept for their gradients."""

    @staticmethod
    def forward(ctx: Any, predicted: Tensor, truth: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:  # noqa: ANN401, D102
        # Chosen, not multiplied: padding may hold what is not finite.
        error = torch.where(mask, predicted - truth, 0.0)
        ctx.save_for_backward(error, mask)
        return _square_sum(error), _square_sum(_changes(error, mask))

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_position: Tensor, of_change: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401, D102
        error, mask = ctx.saved_tensors
        slope = error * (2 * of_position)
        # Zero where a loss has no term of changes, which are then not looked at again.
        if error.device.type != "cpu" or of_change.item() != 0:
            change = _changes(error, mask).mul_(2 * of_change)
            # A difference x_{t+1} − x_t passes its gradient to both frames, with opposite signs.
            slope[:, 1:] += change
            slope[:, :-1] -= change
        return slope, None, None


def _changes(error: Tensor, mask: Tensor) -> Tensor:
    """Changes of the error between valid frames (B, T − 1, ...); the last valid frame has none after it."""
    return (error[:, 1:] - error[:, :-1]).mul_(mask[:, 1:])


def _square_sum(values: Tensor) -> Tensor:
    """The sum of squares, added up frame by frame so that a long sum in float32 stays exact."""
    rows = values.flatten(0, 1)
    return torch.linalg.vecdot(rows, rows).sum()
