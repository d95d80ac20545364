"""The style-conditioned rotary Transformer decoder of the dual-path style diffusion paper, section 1.4, figure 3."""

from __future__ import annotations

import math

from jaxtyping import Bool, Float
from torch import Tensor, nn

from facediff.components.decoder.base import Decoder
from facediff.components.layers import Attention, FeedForward
from facediff.registry import decoder


class TokenAttention(Attention):
    """Attention to a few tokens, with the query's map multiplied into the keys and the last map into the values.

    The scores (W_q x + b_q)·k and the mixture Σ_k a_k W_o v_k are the same numbers in another order, and for fewer than
    ``dim`` pairs of head and token two narrow products replace two of ``dim`` by ``dim`` per frame.
    """

    def forward(
        self,
        x: Float[Tensor, "batch frames dim"],
        context: Float[Tensor, "batch keys context_dim"],
        context_mask: Bool[Tensor, "batch keys"] | None = None,
    ) -> Float[Tensor, "batch frames dim"]:
        """Attend from ``x`` to all of ``context``."""
        narrow = self.num_heads * context.shape[1] < x.shape[-1]
        if context_mask is not None or self.rotary is not None or self.dropout or not narrow:
            return super().forward(x, context, context_mask)
        key, value = (self._split(part) for part in self.key_value(context).chunk(2, dim=-1))
        key = key / math.sqrt(key.shape[-1])
        # Weights by head: (heads, head_dim, dim).
        into = self.query.weight.view(self.num_heads, -1, x.shape[-1])
        out = self.out.weight.T.reshape(self.num_heads, -1, x.shape[-1])
        scores = x @ (key @ into).flatten(1, 2).transpose(1, 2)
        offset = key @ self.query.bias.view(self.num_heads, -1, 1)
        scores = scores + offset.flatten(1)[:, None]
        weights = scores.view(*scores.shape[:2], self.num_heads, -1).softmax(dim=-1).flatten(2)
        return weights @ (value @ out).flatten(1, 2) + self.out.bias


class Block(nn.Module):
    """Rotary self-attention over time, cross-attention to the style tokens, feed-forward; pre-norm, residual."""

    def __init__(self, dim: int, style_dim: int, num_heads: int, hidden_dim: int, dropout: float) -> None:
        super().__init__()
        self.time_norm = nn.LayerNorm(dim)
        self.time_attention = Attention(dim, dim, num_heads, rotary=True, dropout=dropout)
        self.style_norm = nn.LayerNorm(dim)
        self.style_attention = TokenAttention(dim, style_dim, num_heads)
        self.feed_forward_norm = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, hidden_dim, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, style: Tensor, mask: Tensor) -> Tensor:
        """``x`` (batch, frames, dim), ``style`` (batch, tokens, style_dim), ``mask`` (batch, frames)."""
        normed = self.time_norm(x)
        x = x + self.dropout(self.time_attention(normed, normed, mask))
        x = x + self.dropout(self.style_attention(self.style_norm(x), style))
        return x + self.dropout(self.feed_forward(self.feed_forward_norm(x)))


@decoder.register("style_transformer")
class StyleTransformer(Decoder):
    """Rotary Transformer whose every block attends to the style tokens; not autoregressive.

    Args:
        dim: channels; given by the system.
        style_dim: channels of a style token; given by the system.
        num_layers: blocks.
        num_heads: attention heads; ``dim / num_heads`` must be even for the rotary positions.
        feed_forward_factor: hidden width of the feed-forward as a multiple of ``dim``.
        dropout: dropout everywhere.
    """

    def __init__(
        self,
        *,
        dim: int,
        style_dim: int,
        num_layers: int = 4,
        num_heads: int = 4,
        feed_forward_factor: int = 4,
        dropout: float = 0.1,
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            Block(dim, style_dim, num_heads, feed_forward_factor * dim, dropout) for _ in range(num_layers)
        )
        self.norm = nn.LayerNorm(dim)

    def forward(
        self,
        fused: Float[Tensor, "batch frames dim"],
        style: Float[Tensor, "batch tokens style_dim"],
        mask: Bool[Tensor, "batch frames"],
    ) -> Float[Tensor, "batch frames dim"]:
        """F_dec of each frame."""
        for block in self.blocks:
            fused = block(fused, style, mask)
        return self.norm(fused)
