"""DiffPoseTalk's denoiser and its process of diffusion.

The network predicts a window of clean motion from a noisy one, the end of the window before it, speech, and a person;
:mod:`facediff.models.published.diffposetalk` is the model around it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.models.published.positions import periodic_positions
from facediff.models.samplers import NoiseProcess

Guidance = Literal["incremental", "independent"]
"""How guided predictions are combined: ``incremental`` adds what each condition changes to those before it;
``independent`` compares every condition with none of them."""

Condition = Literal["audio", "style"]

Threshold = tuple[float, float, float]
"""Quantile of the prediction's magnitudes that it is clamped to, and the bounds of that."""


class PoseDenoiser(nn.Module):
    """Clean motion of a window from noisy motion.

    Its sizes are options of ``DiffPoseTalk``.
    """

    steps_table: Tensor
    memory_mask: Tensor

    def __init__(
        self,
        *,
        channels: int,
        person_dim: int,
        dim: int = 512,
        num_layers: int = 8,
        num_heads: int = 8,
        feed_forward_dim: int = 2048,
        window: int = 100,
        context: int = 10,
        steps: int = 500,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.context = context
        self.person_in = nn.Linear(person_dim, dim)
        self.step_map = nn.Sequential(nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim))
        self.motion_in = nn.Linear(channels + 1, dim)
        self.positions = nn.Parameter(torch.randn(1, 1 + context + window, dim))
        layer = nn.TransformerDecoderLayer(dim, num_heads, feed_forward_dim, dropout, "gelu", batch_first=True)
        self.transformer = nn.TransformerDecoder(layer, num_layers)
        self.motion_out = nn.Sequential(nn.Linear(dim, dim // 2), nn.GELU(), nn.Linear(dim // 2, channels))
        # The released checkpoints hold this table too, and the authors drop it when they load them.
        self.register_buffer("steps_table", periodic_positions(steps + 1, dim, steps + 1), persistent=False)
        # The person attends to all of the speech, a frame to its own moment: True where a token may not attend.
        moments = ~torch.eye(context + window, dtype=torch.bool)
        self.register_buffer("memory_mask", F.pad(moments, (0, 0, 1, 0), value=False), persistent=False)

    def forward(
        self,
        noisy: Float[Tensor, "batch window channels"],
        audio: Float[Tensor, "batch window dim"],
        person: Float[Tensor, "batch person_dim"],
        before: tuple[Float[Tensor, "batch context channels"], Float[Tensor, "batch context dim"]],
        step: Int[Tensor, " batch"],
        real: Float[Tensor, "batch window"] | None = None,
    ) -> Float[Tensor, "batch frames channels"]:
        """The prediction for the frames of context and window.

        Args:
            noisy: standardised motion with the noise of a step.
            audio: speech of the window's frames.
            person: shape and style.
            before: motion and speech of the frames before the window.
            step: of the diffusion, 1 … ``steps``.
            real: 1 on frames that are wanted, 0 on those that fill up the window; all are if None.
        """
        motion_before, audio_before = before
        real = noisy.new_ones(noisy.shape[:2]) if real is None else real
        # The frames before the window are marked as those that fill it up are, in training as well.
        frames = torch.cat([torch.cat([motion_before, noisy], 1), F.pad(real, (self.context, 0))[..., None]], 2)
        token = self.person_in(person) + self.step_map(self.steps_table[step])
        x = torch.cat([token[:, None], self.motion_in(frames)], 1) + self.positions
        x = self.transformer(x, torch.cat([audio_before, audio], 1), memory_mask=self.memory_mask)
        return self.motion_out(x[:, 1:])


class CosineProcess(NoiseProcess):
    """The cosine schedule (Nichol & Dhariwal 2021, eq. 17), clipped, in single precision as published."""

    def __init__(self, steps: int) -> None:
        times = torch.linspace(0, steps, steps + 1, device="cpu")
        left = torch.cos((times / steps + 0.008) / 1.008 * math.pi * 0.5) ** 2
        left = left / left[0]
        super().__init__(variances=(1 - left[1:] / left[:-1]).clamp(1e-4, 0.999))
        # Clipping changes the product, so that it is taken again, as a sum of logarithms as the authors take it.
        self.signal = torch.log(1 - self.variances).cumsum(0).exp()


def guided(branches: Sequence[Tensor], scales: Sequence[float], guidance: Guidance) -> Tensor:
    """Predictions without and with conditions as one."""
    result = branches[0]
    for number, scale in enumerate(scales):
        # Published: independent guidance takes its second difference from the first one's result, since it adds to the
        # prediction it compares with.
        reference = branches[number] if guidance == "incremental" else result
        result = result + scale * (branches[number + 1] - reference)
    return result


def clamped(predicted: Float[Tensor, "batch frames channels"], window: int, threshold: Threshold) -> Tensor:
    """A prediction within ±s of each clip: a quantile of its magnitudes in the window, itself within bounds."""
    quantile, low, high = threshold
    magnitudes = predicted[:, -window:].flatten(1).abs()
    bound = torch.quantile(magnitudes, quantile, dim=1).clamp(low, high)[:, None, None]
    return torch.clamp(predicted, -bound, bound)
