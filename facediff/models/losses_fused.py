"""The losses of :mod:`facediff.models.losses`, fused with the network's last map into one pass over the vertices.

The definitions make the whole prediction (batch, frames, vertices, 3), its differences over time, and as many tensors
again for the gradients. At BIWI's size (23 370 vertices, six clips of 118 frames) the map to the vertices and the
losses took 2.30 s of a step of 3.67 s that way, and take 0.78 s here (tools/benchmarks/RESULTS.md). Each vertex counts
by itself, so vertices are taken a few at a time, small enough for the processor's cache: they are predicted, compared
and back-propagated to the features and the map before the next ones are looked at.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor

from facediff.models.losses import TERMS, Mask, Motion

CACHE_SIZE = 2**20
"""How many coordinates, of all frames together, a block has on a processor: some megabytes."""
DEVICE_SIZE = 2**24
"""The same on an accelerator, where a block should be large and memory is the limit."""


def fused_losses(
    features: Float[Tensor, "batch frames dim"],
    weight: Float[Tensor, "coordinates dim"],
    bias: Float[Tensor, " coordinates"] | None,
    truth: Motion,
    mask: Mask,
    region: Int[Tensor, " upper_face"],
    weights: Mapping[str, float],
    *,
    scale: float = 1.0,
) -> dict[str, Tensor]:
    """The four losses of motion that is a linear map of features, and their weighted sum, in one pass.

    Equal to :func:`facediff.models.losses.training_losses` of the prediction ``features @ weight.T + bias`` and the
    truth ``scale * truth``. Gradients are the sum's alone, and are ready when it is.

    Under autocast to bfloat16 the prediction is made in full precision, since differences over time of half-precision
    motion are noise, and its gradient is back-propagated in bfloat16, as in any linear layer.

    Args:
        features: the map's input.
        weight: the map, all numbers of the first point, then of the second ….
        bias: its constant; None for none.
        truth: true motion.
        mask: valid frames.
        region: indices of the upper-face vertices R; best on the CPU.
        weights: weight of ``reconstruction``, ``velocity``, ``acceleration`` and ``face`` in the sum.
        scale: factor from ``truth`` to the motion that is predicted.

    Returns:
        the four terms by name, without gradient, and their weighted sum ``loss``.
    """
    differentiated = torch.is_grad_enabled() and any(
        part is not None and part.requires_grad for part in (features, weight, bias)
    )
    autocast = torch.is_autocast_enabled(features.device.type) and torch.get_autocast_dtype(features.device.type)
    low = torch.bfloat16 if autocast == torch.bfloat16 else weight.dtype
    factors = [weights[name] for name in TERMS]
    blocks = _Blocks(features, weight, truth, mask, region, factors, scale, differentiated)
    with torch.autocast(features.device.type, enabled=False):
        total, terms = _FusedLosses.apply(features.to(weight.dtype), weight, bias, blocks, low)  # type: ignore[no-untyped-call]
    return {**dict(zip(TERMS, terms.unbind(), strict=True)), "loss": total}


class _FusedLosses(torch.autograd.Function):
    """Values and gradients by blocks of vertices; both are computed in the forward pass."""

    @staticmethod
    def forward(  # noqa: D102 - the class says it
        ctx: Any,  # noqa: ANN401 - PyTorch gives it no type that knows all of it
        features: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        blocks: _Blocks,
        low: torch.dtype,
    ) -> tuple[Tensor, Tensor]:
        frames = features.flatten(0, 1)
        frames_low, terms = frames.to(low), features.new_zeros(4, dtype=_sum_dtype(features.device))
        needed = ctx.needs_input_grad if blocks.differentiated else (False, False, False)
        of_frames = torch.zeros_like(frames) if needed[0] else None
        of_weight = torch.empty_like(weight) if needed[1] else None
        of_bias = torch.empty_like(bias) if bias is not None and needed[2] else None
        for block, rows in enumerate(blocks.rows):
            # Rows are whole points, all numbers of each, since L_face needs the length of each.
            part = weight[rows]
            prediction = frames @ part.T if bias is None else torch.addmm(bias[rows], frames, part.T)
            # The prediction exists for one block at a time, and its memory becomes the gradient's.
            values, slope = blocks.losses(block, prediction.view(*features.shape[:2], -1))
            terms += values
            if slope is None:
                continue
            # The gradients of a linear layer, for the rows of this block.
            slope_low = slope.view(len(frames), -1).to(low)
            if of_frames is not None:
                of_frames += slope_low @ part.to(low)
            if of_weight is not None:
                of_weight[rows] = slope_low.T @ frames_low
            if of_bias is not None:
                of_bias[rows] = slope.sum((0, 1))
        ctx.save_for_backward(None if of_frames is None else of_frames.view_as(features), of_weight, of_bias)
        # Weighted in the wide type, and only then rounded to the weights' own.
        total = sum((factor * term for factor, term in zip(blocks.factors, terms, strict=True)), terms.new_zeros(()))
        terms = terms.to(weight.dtype)
        ctx.mark_non_differentiable(terms)
        return total.to(weight.dtype), terms

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(  # noqa: D102
        ctx: Any,  # noqa: ANN401
        factor: Tensor,
        _: Tensor,
    ) -> tuple[Tensor | None, ...]:
        # Nearly always the sum itself is back-propagated, with the factor 1. It is read on a processor only:
        # on an accelerator that would wait for all work under way.
        if factor.device.type == "cpu" and factor.item() == 1:
            return *ctx.saved_tensors, None, None
        return *(None if grad is None else grad * factor for grad in ctx.saved_tensors), None, None


class _Blocks:
    """The losses of blocks of vertices, with the tables that they share."""

    def __init__(
        self,
        features: Tensor,
        weight: Tensor,
        truth: Tensor,
        mask: Tensor,
        region: Tensor,
        factors: list[float],
        scale: float,
        differentiated: bool,
    ) -> None:
        self.truth, self.factors, self.scale, self.differentiated = truth.flatten(2), factors, scale, differentiated
        self.dims = dims = truth.shape[-1]
        self.valid = mask[..., None].to(weight.dtype)
        self.count = self.valid.sum(1, keepdim=True).clamp_min(1)
        # What each difference of order 0, 1 and 2 counts in its mean over valid frames and coordinates.
        self.shares, valid = [], mask
        # A difference of order k counts where k + 1 neighbouring frames are valid, as in eq. 16 to 18.
        for _ in range(3):
            share = valid.to(weight.dtype) / (valid.sum().clamp_min(1).to(weight.dtype) * len(weight))
            self.shares.append(share[..., None])
            valid = valid[:, 1:] & valid[:, :-1]
        size = CACHE_SIZE if features.device.type == "cpu" else DEVICE_SIZE
        step = max(1, size // (dims * max(1, mask.numel())))
        self.rows = [slice(start, start + dims * step) for start in range(0, len(weight), dims * step)]
        # The upper-face vertices of each block, counted from its first, and what each counts in the mean. Where the
        # indices are on the CPU already, nothing here waits for an accelerator.
        indices, times = torch.unique(region.cpu(), return_counts=True)
        edges = torch.arange(0, len(weight) // dims + step, step)
        sizes = torch.searchsorted(indices, edges).diff().tolist()
        self.upper_face = [
            (part.sub(edge).to(weight.device), many.to(weight) / (len(mask) * len(region)))
            for part, many, edge in zip(indices.split(sizes), times.split(sizes), edges, strict=False)
        ]

    def losses(self, block: int, prediction: Tensor) -> tuple[Tensor, Tensor | None]:
        """The terms' values (4,) over a block, and the gradient of the weighted sum; the prediction is overwritten."""
        truth, (upper, shares) = self.truth[..., self.rows[block]], self.upper_face[block]
        # First, while the prediction is still there: the differences below are written over it.
        face, pull = prediction.new_zeros(()), None
        if len(upper):
            face, pull = self._face(prediction, truth, upper, shares)
        # The velocity of a difference is the difference of velocities, so one difference serves three terms.
        gap = prediction.sub_(truth, alpha=self.scale)
        change = gap[:, 1:] - gap[:, :-1]
        bend = change[:, 1:] - change[:, :-1]
        pairs = [_huber_and_slope(x, share) for x, share in zip((gap, change, bend), self.shares, strict=True)]
        values = torch.stack([*(value for value, _ in pairs), face]).to(_sum_dtype(prediction.device))
        if not self.differentiated:
            return values, None
        # The gradient is formed here, in the forward pass, while the block of differences is still in the cache: kept
        # for a backward pass, the differences of all blocks would have to be stored and read again.
        slope, of_change, of_bend = (slope for _, slope in pairs)
        slope *= self.factors[0]
        of_change *= self.factors[1]
        # A difference x_{t+1} − x_t passes its gradient to both frames, with opposite signs.
        of_change[:, 1:].add_(of_bend, alpha=self.factors[2])
        of_change[:, :-1].sub_(of_bend, alpha=self.factors[2])
        slope[:, 1:] += of_change
        slope[:, :-1] -= of_change
        if pull is not None:
            slope.view(*slope.shape[:2], -1, self.dims)[:, :, upper] += pull.mul_(self.factors[3])
        return values, slope

    def _face(self, prediction: Tensor, truth: Tensor, upper: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
        """L_face of a block's upper-face vertices, and its gradient there (B, T, R, dims)."""
        moved, true = (motion.view(*motion.shape[:2], -1, self.dims)[:, :, upper] for motion in (prediction, truth))
        # The readable form is :func:`facediff.models.losses.face_dynamics_loss` (eq. 19); only its gradient is written
        # out.
        length = torch.linalg.vector_norm(moved, dim=-1)
        off, spread = self._spread(length)
        _, true_spread = self._spread(torch.linalg.vector_norm(true, dim=-1))
        gap = spread - self.scale * true_spread
        # dσ/d|x| = (|x| − mean) / (frames σ) and d|x|/dx = x / |x|; both are 0 where they are not defined.
        pull = off * (gap.sign() * shares / (self.count * spread).where(spread > 0, torch.inf))
        pull = pull / length.where(length > 0, torch.inf)
        return (gap.abs() * shares).sum(), moved.mul_(pull[..., None])

    def _spread(self, length: Tensor) -> tuple[Tensor, Tensor]:
        """What valid frames are off their clip's mean by (B, T, R), and its standard deviation (B, 1, R)."""
        # The population's deviation over valid frames, as losses.masked_std has it; the two must agree, or training and
        # its readable form drift apart.
        mean = (length * self.valid).sum(1, keepdim=True) / self.count
        off = (length - mean) * self.valid
        return off, (off.square().sum(1, keepdim=True) / self.count).sqrt()


def _sum_dtype(device: torch.device) -> torch.dtype:
    """In what sums over blocks are added up: float64, but for Apple's accelerators, which have none."""
    return torch.float32 if device.type == "mps" else torch.float64


def _huber_and_slope(gap: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted sum of Huber losses (δ = 1), and its gradient; the gap is overwritten.

    With c, the gap clamped to ±1, the loss is c · (gap − c / 2) and its slope is c.
    """
    # Without branches: |gap| ≤ 1 gives gap²/2, |gap| > 1 gives |gap| − ½, from one clamp that is the derivative too.
    slope = gap.clamp(-1, 1)
    gap.sub_(slope, alpha=0.5)
    slope *= share
    return gap.mul_(slope).sum(), slope
