"""Squared errors of motion and of its changes, in few passes over the vertices.

Losses are means over every coordinate of every frame, so that on a small model most of a training step is reading and
writing vertices. Written out, error, mask, square, difference and sum are passes of their own, and as many again on the
way back; here errors are kept once and their gradient is one pass.
"""

from __future__ import annotations

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from facediff.models.layers import frame_mask


def squared_errors(
    predicted: Float[Tensor, "batch frames coordinates"],
    truth: Float[Tensor, "batch frames coordinates"],
    frames: Int[Tensor, " batch"] | Bool[Tensor, "batch frames"],
    columns: Bool[Tensor, " coordinates"] | None = None,
) -> tuple[Float[Tensor, ""], Float[Tensor, ""]]:
    """Sums, over the valid frames, of Σ (x̂ − x)² and of Σ (Δx̂ − Δx)², with Δ the change since the frame before.

    Args:
        predicted: motion with gradient.
        truth: true motion in the same unit.
        frames: valid frames of each clip, or which are valid; both motions may hold anything elsewhere.
        columns: coordinates that count; all if None.

    Returns:
        the sum over coordinates of all frames, and of the changes between valid neighbours, of which each clip has one
        fewer.
    """
    mask = (frames if frames.dtype == torch.bool else frame_mask(frames, predicted.shape[1]))[..., None]
    position, change = _SquaredErrors.apply(predicted, truth, mask, columns)  # type: ignore[no-untyped-call]
    return position, change


def mean_squared_error(
    predicted: Float[Tensor, "batch frames coordinates"],
    truth: Float[Tensor, "batch frames coordinates"],
    frames: Int[Tensor, " batch"],
) -> Float[Tensor, ""]:
    """The mean over all numbers of the valid frames: of one clip, PyTorch's own loss."""
    position, _ = squared_errors(predicted, truth, frames)
    return position / (frames.sum() * predicted.shape[2]).clamp_min(1)


def neighbours(mask: Bool[Tensor, "batch frames *one"]) -> Bool[Tensor, "batch steps *one"]:
    """Which frames and the ones after them are valid: the step from the last frame into the padding is no movement."""
    return mask[:, 1:] & mask[:, :-1]


class _SquaredErrors(torch.autograd.Function):
    """Both sums, with the masked error kept for their gradients; clip by clip, which a processor's cache holds."""

    @staticmethod
    def forward(  # noqa: D102 - the class says it
        ctx: Any,  # noqa: ANN401
        predicted: Tensor,
        truth: Tensor,
        mask: Tensor,
        columns: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        # In mixed precision the prediction may be in half precision, which an error and a sum must not be.
        errors = torch.empty_like(predicted, dtype=torch.result_type(predicted, truth))
        pairs, sums = neighbours(mask), errors.new_zeros(2, len(errors))
        for clip, error in enumerate(errors):
            torch.sub(predicted[clip], truth[clip], out=error)
            # Chosen, not multiplied: padding may hold NaN and infinity.
            error.masked_fill_(~mask[clip], 0.0)
            if columns is not None:
                error *= columns
            sums[0, clip] = _square_sum(error)
            sums[1, clip] = _square_sum(_changes(error, pairs[clip]))
        ctx.save_for_backward(errors, pairs)
        position, change = sums.sum(1)
        return position, change

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, of_position: Tensor, of_change: Tensor) -> tuple[Tensor | None, ...]:  # noqa: ANN401, D102
        errors, pairs = ctx.saved_tensors
        slopes = torch.empty_like(errors)
        # Zero where a loss has no term of changes, which are then not looked at again.
        changing = errors.device.type != "cpu" or of_change.item() != 0
        for clip, slope in enumerate(slopes):
            torch.mul(errors[clip], 2 * of_position, out=slope)
            if changing:
                change = _changes(errors[clip], pairs[clip]).mul_(2 * of_change)
                # A difference x_{t+1} − x_t passes its gradient to both frames, with opposite signs.
                slope[1:] += change
                slope[:-1] -= change
        return slopes, None, None, None


def _changes(error: Tensor, pairs: Tensor) -> Tensor:
    """Changes of a clip's error between valid neighbours (T − 1, ...); 0 elsewhere."""
    return (error[1:] - error[:-1]).mul_(pairs)


def _square_sum(rows: Tensor) -> Tensor:
    """The sum of squares, added up frame by frame so that a long sum in float32 stays exact."""
    return torch.linalg.vecdot(rows, rows).sum()
