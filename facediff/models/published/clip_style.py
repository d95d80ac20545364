"""The style encoder that DiffPoseTalk introduced and ARTalk kept: a Transformer over a clip, averaged over its frames.

Sun et al.: "DiffPoseTalk: Speech-Driven Stylistic 3D Facial Animation and Head Pose Generation via Diffusion Models",
2024.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff.models.published.positions import periodic_positions

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles

TABLE_ROWS = 600
"""Rows of the table of positions where a checkpoint brings none."""


class ClipStyleEncoder(nn.Module):
    """A clip of motion to a style vector."""

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
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.motion_in = nn.Linear(channels, dim)
        layer = nn.TransformerEncoderLayer(dim, num_heads, feed_forward_dim, dropout, "gelu", batch_first=True)
        self.transformer = nn.TransformerEncoder(layer, num_layers, enable_nested_tensor=False)
        self.dropout = nn.Dropout(dropout)
        self.register_buffer("table", periodic_positions(rows, dim, rows)[None])

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
        x = self.dropout(self.motion_in(motion) + self.table[0, mask.sum(1)][:, None])
        x = self.transformer(x, src_key_padding_mask=None if bool(mask.all()) else ~mask)
        valid = mask[..., None].to(x)
        return (x * valid).sum(1) / valid.sum(1).clamp_min(1)


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


def read_table(files: AuthorFiles, name: str, dim: int) -> int:
    """Rows of a released style encoder's table of positions, which follows from a formula where a file has none."""
    files.tensors.setdefault(name, periodic_positions(TABLE_ROWS, dim, TABLE_ROWS)[None])
    return files.size(name, 1)
