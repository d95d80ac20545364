"""Content from speech: a Transformer over a window of speech features around each frame."""

from __future__ import annotations

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.components.layers import Attention, FeedForward


class WindowedTransformer(nn.Module):
    """For every frame an encoder over the features around it, and a decoder that asks with the middle one.

    The window of frame t holds frames t − ⌊W/2⌋ … t − ⌊W/2⌋ + W − 1, with zeros past the ends of the clip; the query is
    the encoded feature of frame t itself (style-content disentanglement, "speech animation network").

    Args:
        in_dim: channels of the speech features.
        dim: channels inside.
        out_dim: channels of the content.
        window: frames W around each frame.
        num_heads: attention heads.
        num_layers: encoder layers; one decoder layer follows.
        dropout: dropout everywhere.
    """

    def __init__(
        self,
        *,
        in_dim: int,
        dim: int = 64,
        out_dim: int,
        window: int,
        num_heads: int = 4,
        num_layers: int = 3,
        dropout: float = 0.0,
    ) -> None:
        super().__init__()
        if window < 1:
            raise ValueError(f"a window of {window} frames holds nothing; expected at least 1")
        self.window = window
        self.before = window // 2
        self.embed = nn.Linear(in_dim, dim)
        self.positions = nn.Parameter(torch.randn(window, dim) * 0.02)
        self.layers = nn.ModuleList(WindowLayer(dim, num_heads, dropout) for _ in range(num_layers))
        self.query = WindowLayer(dim, num_heads, dropout)
        self.out = nn.Sequential(nn.LayerNorm(dim), nn.Linear(dim, out_dim))

    def windows(self, features: Float[Tensor, "batch frames dim"]) -> Float[Tensor, "batch frames window dim"]:
        """Each frame's neighbours, zeros past the ends."""
        after = self.window - 1 - self.before
        padded = nn.functional.pad(features, (0, 0, self.before, after))
        return padded.unfold(1, self.window, 1).transpose(2, 3)

    def forward(self, features: Float[Tensor, "batch frames in_dim"]) -> Float[Tensor, "batch frames out_dim"]:
        """Content of every frame; features are zero on padding, which then is like the silence past a clip's end."""
        batch, frames, _ = features.shape
        source = self.windows(features).flatten(0, 1)
        x = self.embed(source) + self.positions
        for layer in self.layers:
            x = layer(x, x)
        middle = x[:, self.before : self.before + 1]
        return self.out(self.query(middle, x)).view(batch, frames, -1)


class WindowLayer(nn.Module):
    """Pre-norm attention from ``x`` to ``context``, then a feed-forward part."""

    def __init__(self, dim: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(dim)
        self.attention = Attention(dim, dim, num_heads, dropout=dropout)
        self.feed_forward = nn.Sequential(nn.LayerNorm(dim), FeedForward(dim, 2 * dim, dropout))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, context: Tensor) -> Tensor:
        """``x`` (batch, queries, dim), ``context`` (batch, keys, dim)."""
        x = x + self.dropout(self.attention(self.norm(x), self.norm(context)))
        return x + self.dropout(self.feed_forward(x))
