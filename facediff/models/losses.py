"""The four training losses of the dual-path style diffusion paper, section 1.5.

All take padded batches with a frame mask; padding never counts, so that a clip's loss does not depend on how far it
is padded. Motion is (batch, frames, vertices, 3): offsets from the template.

Each loss has a function of its own, which says what it is. Training takes all four at once, from
:func:`losses_of_linear`: the same values and gradients in one pass over the vertices.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor

Motion = Float[Tensor, "batch frames vertices 3"]
Mask = Bool[Tensor, "batch frames"]
Scalar = Float[Tensor, ""]


def huber(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """Mean Huber loss (δ = 1) over the coordinates of all valid frames; 0 if there is none."""
    loss = F.huber_loss(prediction, truth, reduction="none").mean((2, 3))
    return (loss * mask).sum() / mask.sum().clamp_min(1)


def reconstruction_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_recon = Huber(M⁰, M̂⁰) (eq. 16)."""
    return huber(prediction, truth, mask)


def velocity_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_vel: Huber loss of the first differences over time (eq. 17); 0 for a single frame."""
    both = mask[:, 1:] & mask[:, :-1]
    return huber(prediction.diff(dim=1), truth.diff(dim=1), both)


def acceleration_loss(prediction: Motion, truth: Motion, mask: Mask) -> Scalar:
    """L_acc: Huber loss of the second differences over time (eq. 18); exactly 0 below three frames."""
    if prediction.shape[1] < 3:
        return prediction.new_zeros(())
    all_three = mask[:, 2:] & mask[:, 1:-1] & mask[:, :-2]
    return huber(prediction.diff(n=2, dim=1), truth.diff(n=2, dim=1), all_three)


def masked_std(values: Float[Tensor, "batch frames vertices"], mask: Mask) -> Float[Tensor, "batch vertices"]:
    """Population standard deviation over each clip's valid frames; its gradient is 0 where it is 0."""
    weight = mask[..., None].to(values.dtype)
    count = weight.sum(1).clamp_min(1)
    mean = (values * weight).sum(1) / count
    variance = ((values - mean[:, None]).square() * weight).sum(1) / count
    positive = variance > 0
    return torch.where(positive, variance.where(positive, torch.ones_like(variance)).sqrt(), 0.0)


def face_dynamics_loss(prediction: Motion, truth: Motion, mask: Mask, region: Int[Tensor, " upper_face"]) -> Scalar:
    """L_face: mean over upper-face vertices of |σ − σ̂| (eq. 19).

    σ is the standard deviation over time of the length of a vertex's displacement.

    Args:
        prediction: predicted motion.
        truth: true motion.
        mask: valid frames.
        region: indices of the upper-face vertices R.
    """
    deviation = [masked_std(torch.linalg.vector_norm(m[:, :, region], dim=-1), mask) for m in (truth, prediction)]
    return (deviation[0] - deviation[1]).abs().mean()


def losses_of_linear(
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

    Equal to the functions above on the prediction ``features @ weight.T + bias`` and the truth ``scale * truth``. The
    velocity of a difference is the difference of velocities, so one difference serves three terms; and as each vertex
    counts by itself, vertices are taken a few at a time, small enough for the processor's cache: the prediction is
    predicted, compared and led back to the gradients of features and map without ever being there as a whole. Gradients
    are therefore those of the sum alone, and are ready when it is.

    Under autocast to bfloat16 the prediction is made in full precision, since differences over time of half-precision
    motion are noise, and its gradient is led back in bfloat16, as in any linear layer.

    Args:
        features: what the map is applied to.
        weight: the map, coordinates in the order x, y, z of each vertex.
        bias: its constant; None for none.
        truth: true motion.
        mask: valid frames.
        region: indices of the upper-face vertices R; best on the CPU.
        weights: weight of ``reconstruction``, ``velocity``, ``acceleration`` and ``face`` in the sum.
        scale: factor from ``truth`` to the motion that is predicted.

    Returns:
        the four terms by name, without gradient, and their weighted sum ``loss``.
    """
    factors = [weights[name] for name in TERMS]
    wanted = torch.is_grad_enabled() and any(
        part is not None and part.requires_grad for part in (features, weight, bias)
    )
    low = torch.is_autocast_enabled(features.device.type) and torch.get_autocast_dtype(features.device.type)
    task = _Task(truth, mask, region, factors, scale, wanted, torch.bfloat16 if low == torch.bfloat16 else None)
    with torch.autocast(features.device.type, enabled=False):
        total, terms = _LossesOfLinear.apply(features.to(weight.dtype), weight, bias, task)  # type: ignore[no-untyped-call]
    return {**dict(zip(TERMS, terms.unbind(), strict=True)), "loss": total}


TERMS = ("reconstruction", "velocity", "acceleration", "face")
CACHE_SIZE = 2**20
"""How many coordinates, of all frames together, are looked at in one go on a processor: some megabytes."""
DEVICE_SIZE = 2**24
"""The same on an accelerator, where a go should be large and memory is the limit."""


@dataclass(frozen=True)
class _Task:
    """What :func:`losses_of_linear` was asked for, with its tables.

    Attributes:
        truth: true motion (B, T, V, 3).
        mask: valid frames (B, T).
        region: upper-face vertices.
        factors: weights of the terms.
        scale: factor on the truth.
        wanted: whether gradients are wanted.
        low: type of the matrix products that lead gradients back; that of the weights if None.
    """

    truth: Tensor
    mask: Tensor
    region: Tensor
    factors: list[float]
    scale: float
    wanted: bool
    low: torch.dtype | None

    def shares(self, order: int, like: Tensor) -> Tensor:
        """What each difference of an order counts in its mean over valid frames and coordinates: (B, T - order, 1)."""
        valid = self.mask
        for _ in range(order):
            valid = valid[:, 1:] & valid[:, :-1]
        return (valid.to(like.dtype) / (valid.sum().clamp_min(1).to(like.dtype) * len(like)))[..., None]


class _LossesOfLinear(torch.autograd.Function):
    """Values and gradients of :func:`losses_of_linear` by blocks of vertices; both are made on the way forward."""

    @staticmethod
    def forward(  # noqa: D102 - the class says it
        ctx: Any,  # noqa: ANN401 - PyTorch gives it no type that knows all of it
        features: Tensor,
        weight: Tensor,
        bias: Tensor | None,
        task: _Task,
    ) -> tuple[Tensor, Tensor]:
        frames = features.flatten(0, 1)
        size = CACHE_SIZE if features.device.type == "cpu" else DEVICE_SIZE
        step = max(1, size // (3 * max(1, len(frames))))
        blocks = _Blocks(task, weight, step)
        low = task.low or weight.dtype
        entered, terms = frames.to(low), features.new_zeros(4, dtype=exact_type(features.device))
        needed = [task.wanted and each for each in ctx.needs_input_grad]
        into = torch.zeros_like(frames) if needed[0] else None
        of_weight = torch.empty_like(weight) if needed[1] else None
        of_bias = torch.empty_like(bias) if bias is not None and needed[2] else None
        for place, start in enumerate(range(0, len(weight), 3 * step)):
            rows = slice(start, start + 3 * step)
            guess = frames @ weight[rows].T if bias is None else torch.addmm(bias[rows], frames, weight[rows].T)
            values, slope = blocks(place, rows, guess.view(*features.shape[:2], -1))
            terms += values
            if slope is None:
                continue
            back = slope.view(len(frames), -1).to(low)
            if into is not None:
                into += back @ weight[rows].to(low)
            if of_weight is not None:
                of_weight[rows] = back.T @ entered
            if of_bias is not None:
                of_bias[rows] = slope.sum((0, 1))
        ctx.save_for_backward(None if into is None else into.view_as(features), of_weight, of_bias)
        total = sum((factor * term for factor, term in zip(task.factors, terms, strict=True)), terms.new_zeros(()))
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
        # The sum is nearly always what is led back itself; on an accelerator, looking would wait for it.
        if factor.device.type == "cpu" and factor.item() == 1:
            return *ctx.saved_tensors, None
        return *(None if grad is None else grad * factor for grad in ctx.saved_tensors), None


class _Blocks:
    """The losses of a block of vertices.

    Args:
        task: what is asked for.
        weight: the map, for its number of coordinates and its type.
        step: vertices a block.
    """

    def __init__(self, task: _Task, weight: Tensor, step: int) -> None:
        self.task = task
        self.shares = [task.shares(order, weight) for order in range(3)]
        self.valid = task.mask[..., None].to(weight.dtype)
        self.count = self.valid.sum(1, keepdim=True).clamp_min(1)
        # Where the indices are on the CPU already, nothing here waits for an accelerator.
        indices, times = torch.unique(task.region.cpu(), return_counts=True)
        edges = torch.arange(0, len(weight) // 3 + step, step)
        sizes = torch.searchsorted(indices, edges).diff().tolist()
        self.inside = [
            (part.sub(edge).to(weight.device), many.to(weight) / (len(task.mask) * len(task.region)))
            for part, many, edge in zip(indices.split(sizes), times.split(sizes), edges, strict=False)
        ]

    def __call__(self, place: int, rows: slice, guess: Tensor) -> tuple[Tensor, Tensor | None]:
        """The terms' values (4,) over a block, and the gradient of the weighted sum; the prediction is overwritten."""
        task = self.task
        truth, (inside, counts) = task.truth.flatten(2)[..., rows], self.inside[place]
        face, pull = (guess.new_zeros(()), None) if not len(inside) else self._face(guess, truth, inside, counts)
        gap = guess.sub_(truth, alpha=task.scale)
        change = gap[:, 1:] - gap[:, :-1]
        bend = change[:, 1:] - change[:, :-1]
        found = [_huber_and_slope(x, share) for x, share in zip((gap, change, bend), self.shares, strict=True)]
        values = torch.stack([*(value for value, _ in found), face]).to(exact_type(guess.device))
        if not task.wanted:
            return values, None
        slope, of_change, of_bend = (one for _, one in found)
        slope *= task.factors[0]
        of_change *= task.factors[1]
        of_change[:, 1:].add_(of_bend, alpha=task.factors[2])
        of_change[:, :-1].sub_(of_bend, alpha=task.factors[2])
        slope[:, 1:] += of_change
        slope[:, :-1] -= of_change
        if pull is not None:
            slope.view(*slope.shape[:2], -1, 3)[:, :, inside] += pull.mul_(task.factors[3])
        return values, slope

    def _face(self, guess: Tensor, truth: Tensor, inside: Tensor, counts: Tensor) -> tuple[Tensor, Tensor]:
        """L_face of a block's upper-face vertices ``inside``, and its gradient there (B, T, R, 3)."""
        moved, wanted = (motion.view(*motion.shape[:2], -1, 3)[:, :, inside] for motion in (guess, truth))
        length = torch.linalg.vector_norm(moved, dim=-1)
        off, spread = self._spread(length)
        _, wanted_spread = self._spread(torch.linalg.vector_norm(wanted, dim=-1))
        gap = spread - self.task.scale * wanted_spread
        # dσ/d|x| = (|x| − mean) / (frames σ) and d|x|/dx = x / |x|; both are 0 where they are not defined.
        pull = off * (gap.sign() * counts / (self.count * spread).where(spread > 0, torch.inf))
        pull = pull / length.where(length > 0, torch.inf)
        return (gap.abs() * counts).sum(), moved.mul_(pull[..., None])

    def _spread(self, length: Tensor) -> tuple[Tensor, Tensor]:
        """What valid frames are off their clip's mean by (B, T, R), and its standard deviation (B, 1, R)."""
        mean = (length * self.valid).sum(1, keepdim=True) / self.count
        off = (length - mean) * self.valid
        return off, (off.square().sum(1, keepdim=True) / self.count).sqrt()


def exact_type(device: torch.device) -> torch.dtype:
    """In what sums over blocks are added up: float64, but for Apple's accelerators, which have none."""
    return torch.float32 if device.type == "mps" else torch.float64


def _huber_and_slope(gap: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted sum of Huber losses (δ = 1), and its gradient; the gap is overwritten.

    With c, the gap clamped to ±1, the loss is c · (gap − c / 2) and its slope is c.
    """
    slope = gap.clamp(-1, 1)
    gap.sub_(slope, alpha=0.5)
    slope *= share
    return gap.mul_(slope).sum(), slope
