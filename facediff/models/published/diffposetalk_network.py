"""DiffPoseTalk's denoiser and its process of diffusion.

The network predicts a window of clean motion from a noisy one, the end of the window before it, speech, and a person;
:mod:`facediff.models.published.diffposetalk` is the model around it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.models.published.clip_style import sinusoids

Guidance = Literal["incremental", "independent"]
"""How guided predictions are combined: ``incremental`` adds what each condition changes to those before it;
``independent`` compares every condition with none of them."""

Condition = Literal["audio", "style"]

Threshold = tuple[float, float, float]
"""Quantile of the prediction's magnitudes that it is clamped to, and the bounds of that."""


class PoseDenoiser(nn.Module):
    """Clean motion of a window from noisy motion.

    Args:
        channels: numbers of a frame of motion.
        person_dim: numbers that describe the person: shape and style.
        dim: channels of the Transformer.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers.
        window: frames that are predicted in one pass.
        context: frames before them.
        steps: of the diffusion.
        indicator: tell the network which frames are real and which fill up the last window.
        memory_width: frames that lie fewer than so many frames from a moment of speech attend to it: 1 for each frame's
            own moment alone, as published; 0 for all speech.
        dropout: in the Transformer, in training.
    """

    steps_table: Tensor
    memory_mask: Tensor | None

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
        indicator: bool = True,
        memory_width: int = 1,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.window, self.context, self.indicator = window, context, indicator
        self.person_in = nn.Linear(person_dim, dim)
        self.step_map = nn.Sequential(nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim))
        self.motion_in = nn.Linear(channels + indicator, dim)
        self.positions = nn.Parameter(torch.randn(1, 1 + context + window, dim))
        layer = nn.TransformerDecoderLayer(dim, num_heads, feed_forward_dim, dropout, "gelu", batch_first=True)
        self.transformer = nn.TransformerDecoder(layer, num_layers)
        self.motion_out = nn.Sequential(nn.Linear(dim, dim // 2), nn.GELU(), nn.Linear(dim // 2, channels))
        # The released checkpoints hold this table too, and the authors drop it when they load them.
        self.register_buffer("steps_table", sinusoids(steps + 1, dim), persistent=False)
        self.register_buffer(
            "memory_mask", frame_alignment(context + window, memory_width) if memory_width else None, persistent=False
        )

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
        frames = torch.cat([motion_before, noisy], 1)
        if self.indicator:
            real = noisy.new_ones(noisy.shape[:2]) if real is None else real
            # The frames before the window are marked as those that fill it up are, in training as well.
            frames = torch.cat([frames, F.pad(real, (self.context, 0))[..., None]], 2)
        token = self.person_in(person) + self.step_map(self.steps_table[step])
        x = torch.cat([token[:, None], self.motion_in(frames)], 1) + self.positions
        x = self.transformer(x, torch.cat([audio_before, audio], 1), memory_mask=self.memory_mask)
        return self.motion_out(x[:, 1:])


def frame_alignment(frames: int, width: int) -> Bool[Tensor, "queries keys"]:
    """True where a token may not attend: the person attends to all of the speech, frames to moments near their own."""
    places = torch.arange(frames)
    return F.pad((places[:, None] - places).abs() >= width, (0, 0, 1, 0), value=False)


class CosineProcess(nn.Module):
    """The process of diffusion: variances of the cosine schedule (Nichol & Dhariwal 2021, eq. 17), clipped.

    Args:
        steps: noising steps; step 0 is clean motion.
        offset: s of the schedule.

    Attributes:
        alphas: 1 − β of the steps.
        signal: ᾱ of the steps, the share of clean motion's variance that is left.
        deviations: of the noise that a step of the reverse process adds: the posterior's.
    """

    alphas: Tensor
    signal: Tensor
    deviations: Tensor

    def __init__(self, steps: int = 500, offset: float = 0.008) -> None:
        super().__init__()
        times = torch.linspace(0, steps, steps + 1)
        left = torch.cos((times / steps + offset) / (1 + offset) * math.pi * 0.5) ** 2
        left = left / left[0]
        variances = F.pad((1 - left[1:] / left[:-1]).clamp(1e-4, 0.999), (1, 0))
        # Clipping changes the product, so that it is taken again, as a sum of logarithms as the authors take it.
        signal = torch.log(1 - variances).cumsum(0).exp()
        posterior = F.pad((1 - signal[:-1]) / (1 - signal[1:]) * variances[1:], (1, 0))
        self.register_buffer("alphas", 1 - variances)
        self.register_buffer("signal", signal)
        self.register_buffer("deviations", posterior.sqrt())

    @property
    def steps(self) -> int:
        """Noising steps."""
        return len(self.signal) - 1

    def noised(
        self, clean: Float[Tensor, "batch frames channels"], step: Int[Tensor, " batch"], noise: Tensor
    ) -> Float[Tensor, "batch frames channels"]:
        """√ᾱ x + √(1 − ᾱ) ε of a step."""
        signal = self.signal[step].view(-1, 1, 1)
        return signal.sqrt() * clean + (1 - signal).sqrt() * noise

    def before(self, noisy: Tensor, clean: Tensor, step: int, noise: Tensor | None) -> Tensor:
        """Motion of the step before: the posterior's mean of the predicted clean motion, and noise but for the last."""
        alpha, signal, signal_before = self.alphas[step], self.signal[step], self.signal[step - 1]
        of_noisy = (1 - signal_before) * torch.sqrt(alpha) / (1 - signal)
        of_clean = (1 - alpha) * torch.sqrt(signal_before) / (1 - signal)
        mean = of_noisy * noisy + of_clean * clean
        return mean if noise is None else mean + self.deviations[step] * noise


def guided(branches: Sequence[Tensor], scales: Sequence[float], guidance: Guidance, *, literal: bool = True) -> Tensor:
    """Predictions without and with conditions as one.

    Args:
        branches: without any condition, then one for each condition in turn.
        scales: one for each condition.
        guidance: see :data:`Guidance`.
        literal: take the second difference of ``independent`` from what the first one gave, as the published code does,
            which adds to the prediction it compares with; else from the prediction without conditions.
    """
    result = branches[0]
    for number, scale in enumerate(scales):
        if guidance == "incremental":
            reference = branches[0] if number == 0 else branches[number]
        else:
            reference = result if literal else branches[0]
        result = result + scale * (branches[number + 1] - reference)
    return result


def clamped(predicted: Float[Tensor, "batch frames channels"], window: int, threshold: Threshold) -> Tensor:
    """A prediction within ±s of each clip: a quantile of its magnitudes in the window, itself within bounds."""
    quantile, low, high = threshold
    magnitudes = predicted[:, -window:].flatten(1).abs()
    bound = torch.quantile(magnitudes, quantile, dim=1).clamp(low, high)[:, None, None]
    return torch.clamp(predicted, -bound, bound)


Draw = Callable[[Tensor], Tensor]
"""New unit Gaussian noise like a tensor."""
