"""The style encoder that DiffPoseTalk introduced and ARTalk kept: a Transformer over a clip, averaged over its frames.

Sun et al.: "DiffPoseTalk: Speech-Driven Stylistic 3D Facial Animation and Head Pose Generation via Diffusion Models",
2024.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

if TYPE_CHECKING:
    from facediff.models.published.recognition import AuthorsWeights

StylePositions = Literal["published", "frames"]
"""Positions of a style clip: ``published`` adds one row, that of the clip's length, to all frames; ``frames`` gives
every frame its own row, as was meant."""

TABLE_ROWS = 600
"""Rows of the table of positions where a checkpoint brings none."""


class ClipStyleEncoder(nn.Module):
    """A clip of motion to a style vector.

    Args:
        channels: numbers of a frame.
        dim: channels of the Transformer, and of the style.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers.
        rows: rows of the table of positions; a clip has fewer frames.
        positions: see :data:`StylePositions`.
        dropout: in the Transformer, in training.
    """

    table: Tensor

    def __init__(
        self,
        channels: int,
        dim: int = 128,
        *,
        num_layers: int = 4,
        num_heads: int = 4,
        feed_forward_dim: int = 512,
        rows: int = TABLE_ROWS,
        positions: StylePositions = "published",
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.positions: StylePositions = positions
        self.motion_in = nn.Linear(channels, dim)
        layer = nn.TransformerEncoderLayer(dim, num_heads, feed_forward_dim, dropout, "gelu", batch_first=True)
        self.transformer = nn.TransformerEncoder(layer, num_layers, enable_nested_tensor=False)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("table", sinusoids(rows, dim)[None])

    @property
    def longest(self) -> int:
        """Frames of the longest clip that the table of positions allows."""
        return self.table.shape[1] - 1

    def forward(
        self, motion: Float[Tensor, "batch frames channels"], mask: Bool[Tensor, "batch frames"] | None = None
    ) -> Float[Tensor, "batch dim"]:
        """Style vectors.

        Args:
            motion: standardised; frames beyond :attr:`longest` are left out.
            mask: True on valid frames, which come first; all are if None.
        """
        motion = motion[:, : self.longest]
        batch, frames = motion.shape[:2]
        mask = torch.ones(batch, frames, dtype=torch.bool, device=motion.device) if mask is None else mask[:, :frames]
        # The authors index the table with the number of frames, so one row stands for all of them and the order of the
        # frames has no influence. Released weights were trained so.
        literal = self.positions == "published"
        rows = self.table[0, mask.sum(1)][:, None] if literal else self.table[:, :frames]
        x = self.dropout(self.motion_in(motion) + rows)
        x = self.transformer(x, src_key_padding_mask=None if bool(mask.all()) else ~mask)
        valid = mask[..., None].to(x)
        return (x * valid).sum(1) / valid.sum(1).clamp_min(1)


def sinusoids(rows: int, dim: int) -> Float[Tensor, "rows dim"]:
    """sin(n·w_k) on even channels and cos(n·w_k) on odd ones, w_k = 10000^(−2k/dim), of the row n."""
    frequencies = torch.exp(torch.arange(0, dim, 2, dtype=torch.float32) * (-math.log(10_000.0) / dim))
    angles = torch.arange(rows, dtype=torch.float32)[:, None] * frequencies
    return torch.stack([angles.sin(), angles.cos()], 2).flatten(1)[:, :dim]


def style_contrast(
    first: Float[Tensor, "batch dim"], second: Float[Tensor, "batch dim"], temperature: float = 0.1
) -> Float[Tensor, ""]:
    """NT-Xent (Chen et al. 2020, eq. 1) of two clips of the same people: each one's other clip against all the rest."""
    vectors = F.normalize(torch.cat([first, second]), dim=1)
    count = len(first)
    similarity = vectors @ vectors.T / temperature
    similarity = similarity.masked_fill(torch.eye(2 * count, dtype=torch.bool, device=first.device), -torch.inf)
    partners = torch.arange(2 * count, device=first.device).roll(count)
    return F.cross_entropy(similarity, partners)


def convert_style(weights: AuthorsWeights, old: str, new: str) -> int:
    """Use a released style encoder's tensors; its table of positions follows from a formula where a file has none.

    Args:
        weights: the tensors of the files.
        old: how the authors' names begin, before ``encoder.``.
        new: how the model's names begin.

    Returns:
        rows of the table of positions.
    """
    # A style file of DiffPoseTalk may hold the module ``encoder`` alone, whose names then lack it.
    inner = f"{old}encoder." if f"{old}encoder.motion_proj.weight" in weights else old
    weights.move_all(f"{inner}motion_proj.", f"{new}motion_in.")
    weights.move_all(f"{inner}transformer.", f"{new}transformer.")
    dim, _ = weights.shape(f"{inner}motion_proj.weight")
    if f"{old}PE.pe" in weights:
        rows = weights.shape(f"{old}PE.pe", 3)[1]
        weights.move(f"{old}PE.pe", f"{new}table")
        return rows
    weights.add(f"{new}table", sinusoids(TABLE_ROWS, dim)[None])
    return TABLE_ROWS
