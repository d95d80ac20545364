"""A recurrent decoder, the form that FaceDiffuser uses, for comparison by name."""

from __future__ import annotations

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn
from torch.nn.utils.rnn import pack_padded_sequence, pad_packed_sequence

from facediff.components.decoder.base import Decoder
from facediff.registry import decoder


class GruConstants(NamedTuple):
    """What the decoding of a clip does not compute in every step.

    Attributes:
        lengths: valid frames of each clip, on the CPU.
        scale: factor on the result, (batch, 1, dim).
        shift: what is added to it, (batch, 1, dim).
    """

    lengths: Tensor
    scale: Tensor
    shift: Tensor


@decoder.register("gru")
class GruDecoder(Decoder):
    """Gated recurrent units over time, scaled and shifted by the mean style token.

    Args:
        dim: channels; given by the system.
        style_dim: channels of a style token; given by the system.
        num_layers: recurrent layers.
        bidirectional: also read the sequence backwards (needs an even ``dim``).
        dropout: dropout between recurrent layers.
    """

    def __init__(
        self,
        *,
        dim: int,
        style_dim: int,
        num_layers: int = 2,
        bidirectional: bool = True,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        if bidirectional and dim % 2:
            raise ValueError(f"dim must be even for a bidirectional gru decoder, got {dim}")
        self.gru = nn.GRU(
            dim,
            dim // 2 if bidirectional else dim,
            num_layers,
            batch_first=True,
            bidirectional=bidirectional,
            dropout=dropout if num_layers > 1 else 0.0,
        )
        self.modulation = nn.Linear(style_dim, 2 * dim)
        self.norm = nn.LayerNorm(dim)

    def forward(
        self,
        fused: Float[Tensor, "batch frames dim"],
        style: Float[Tensor, "batch tokens style_dim"],
        mask: Bool[Tensor, "batch frames"],
        prepared: GruConstants | None = None,
    ) -> Float[Tensor, "batch frames dim"]:
        """F_dec of each frame.

        Args:
            fused: F_fused.
            style: style tokens.
            mask: True on valid frames.
            prepared: as :meth:`prepare` gives it.
        """
        lengths, scale, shift = self.prepare(style, mask) if prepared is None else prepared
        packed = pack_padded_sequence(fused, lengths, batch_first=True, enforce_sorted=False)
        hidden, _ = pad_packed_sequence(self.gru(packed)[0], batch_first=True, total_length=fused.shape[1])
        return torch.addcmul(shift, self.norm(hidden + fused), scale)

    def prepare(
        self, style: Float[Tensor, "batch tokens style_dim"], mask: Bool[Tensor, "batch frames"]
    ) -> GruConstants:
        """The lengths, for which the device must be waited for, and the modulation by the style."""
        scale, shift = self.modulation(style.mean(1, keepdim=True)).chunk(2, dim=-1)
        return GruConstants(mask.sum(1).cpu(), 1 + scale, shift)
