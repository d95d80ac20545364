"""Convolutions over frames that LAM-Audio2Expression and UniTalker build their decoders of."""

from __future__ import annotations

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn


class NormedConvolution(nn.Module):
    """A convolution over three frames, layer norm over channels, the input added if ``residual``, ReLU."""

    def __init__(self, inputs: int, outputs: int, *, residual: bool) -> None:
        super().__init__()
        self.conv = nn.Conv1d(inputs, outputs, 3, padding=1)
        self.norm = nn.LayerNorm(outputs)
        self.residual = residual
        self.widen = nn.Conv1d(inputs, outputs, 3, padding=1) if residual and inputs != outputs else None

    def forward(self, x: Float[Tensor, "batch frames inputs"], mask: Bool[Tensor, "batch frames 1"] | None) -> Tensor:
        """(batch, frames, outputs); frames outside the ``mask`` count as the zeros beyond a clip's end."""
        if mask is not None:
            x = x * mask
        turned = x.transpose(1, 2)
        result: Tensor = self.norm(self.conv(turned).transpose(1, 2))
        if self.residual:
            result = result + (x if self.widen is None else self.widen(turned).transpose(1, 2))
        return torch.relu(result)


class ConvolutionStack(nn.Module):
    """Several :class:`NormedConvolution` one after the other."""

    def __init__(self, inputs: int, outputs: int, *, layers: int = 3, residual: bool = True) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            NormedConvolution(inputs if layer == 0 else outputs, outputs, residual=residual) for layer in range(layers)
        )

    def forward(
        self, x: Float[Tensor, "batch frames inputs"], mask: Bool[Tensor, "batch frames"] | None = None
    ) -> Tensor:
        """(batch, frames, outputs), where what lies outside the mask has no meaning."""
        spread = None if mask is None else mask[..., None]
        for layer in self.layers:
            x = layer(x, spread)
        return x
