"""Sinusoids of frame numbers and the attention's bias, both periodic, as FaceFormer introduced them."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor


def periodic_positions(
    frames: int, dim: int, period: int, *, start: int = 0, device: torch.device | None = None
) -> Float[Tensor, "frames dim"]:
    """Row p: sin((p mod period)·w_m) in the even channels 2m, the cosines in the odd ones, w_m = 10000^(−2m/dim)."""
    steps = torch.arange(start, start + frames, device=device) % period
    rates = torch.exp(torch.arange(0, dim, 2, device=device).float() * (-math.log(10_000.0) / dim))
    angle = steps[:, None].float() * rates
    return torch.stack([angle.sin(), angle.cos()], -1).flatten(1)


def periodic_bias(
    frames: int, heads: int, period: int, *, start: int = 0, device: torch.device | None = None
) -> Float[Tensor, "heads frames positions"]:
    """−2^(−8(h+1)/heads)·⌊(i − j)/period⌋ for head h, frame i and position j ≤ i; −∞ for j > i."""
    rows = torch.arange(start, start + frames, device=device)[:, None]
    distance = rows - torch.arange(start + frames, device=device)
    return distance_bias(distance, heads, period).masked_fill(distance < 0, -torch.inf)


def distance_bias(distance: Int[Tensor, "frames positions"], heads: int, period: int) -> Tensor:
    """−2^(−8(h+1)/heads)·⌊distance/period⌋ for head h, (heads, frames, positions)."""
    # ALiBi's slopes (Press et al. 2022) on the distance in whole periods, as in FaceFormer, so that the frames of one
    # period count alike. Added to the scaled scores, as PyTorch does with a float mask.
    slopes = 2.0 ** (-8.0 * torch.arange(1, heads + 1, device=distance.device).float() / heads)
    return -slopes[:, None, None] * torch.div(distance, period, rounding_mode="floor")
