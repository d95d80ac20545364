"""Embedding of the diffusion step, computed step by step or as a table of all steps."""

from __future__ import annotations

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn


class StepEmbedding(nn.Module):
    """t_emb: sinusoids of the diffusion step, then an MLP.

    Args:
        dim: channels C.
    """

    frequencies: Tensor

    def __init__(self, dim: int) -> None:
        super().__init__()
        half = dim // 2
        frequencies = torch.exp(-math.log(10_000.0) * torch.arange(half) / half)
        self.register_buffer("frequencies", frequencies, persistent=False)
        self.mlp = nn.Sequential(nn.Linear(2 * half, dim), nn.SiLU(), nn.Linear(dim, dim))
        self._table: Tensor | None = None
        self._weights: list[Tensor] = []

    def forward(self, step: Int[Tensor, " batch"]) -> Float[Tensor, "batch dim"]:
        """Embed step numbers counted from 0."""
        angle = step[:, None].float() * self.frequencies
        return self.mlp(torch.cat([angle.sin(), angle.cos()], dim=-1))

    def table(self, steps: int) -> Float[Tensor, "steps dim"]:
        """The embeddings of all steps, without gradient; kept until the weights are found changed.

        Args:
            steps: the process's steps N.
        """
        weights = [self.frequencies, *self.mlp.parameters()]
        # Without inference mode, whose tensors could not be used outside of it later.
        with torch.inference_mode(False), torch.no_grad(), torch.autocast(self.frequencies.device.type, enabled=False):
            kept = self._table
            if kept is None or len(kept) != steps or not all(map(same, weights, self._weights)):
                kept = self._table = self(torch.arange(steps, device=self.frequencies.device))
                # The weights themselves are looked at: no counter sees how averaged weights are swapped in and out.
                self._weights = [weight.detach().clone() for weight in weights]
        return kept


def same(one: Tensor, other: Tensor) -> bool:
    """Whether two tensors are equal, also in type and place."""
    return one.dtype == other.dtype and one.device == other.device and torch.equal(one, other)
