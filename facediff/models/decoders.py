"""Decoders of fused features under a style: a rotary Transformer (dual-path paper, figure 3) and a recurrent one."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Annotated, ClassVar, NamedTuple, Protocol, cast

import torch
from jaxtyping import Float
from torch import Tensor, nn

from facediff.errors import ArgumentError
from facediff.models.layers import (
    Attention,
    AttentionContext,
    FeedForward,
    FrameMask,
    Frames,
    Heads,
    Layers,
    Rotation,
    Share,
    Width,
    all_states,
    exporting,
    needed_mask,
)
from facediff.registry import decoder
from facediff.utils.ranges import Range

Tokens = Float[Tensor, "batch tokens style_dim"]
"""The style condition F_s."""


class Decoder(nn.Module, ABC):
    """Fused features F_fused and style tokens F_s to features that one linear map turns into clean motion.

    Class attributes:
        graph_takes_padding: whether an exported graph may decode clips of several lengths together.
    """

    graph_takes_padding: ClassVar[bool] = True

    def prepare(self, style: Tokens, mask: FrameMask) -> object:
        """What stays the same over the denoising steps, computed once a clip; None if there is nothing.

        A decoder that overrides this takes the result as a fourth, optional argument of ``forward`` and gives the same
        with it as without, up to rounding. The arguments are those that ``forward`` will get.
        """
        return None

    @abstractmethod
    def forward(self, fused: Frames, style: Tokens, mask: FrameMask) -> Frames:
        """Decode; there is at least one style token; frames where ``mask`` is False are padding."""


class DecoderFactory(Protocol):
    """Makes a decoder once the model's widths are known."""

    def __call__(self, *, dim: int, style_dim: int) -> Decoder:
        """Make one for ``dim`` channels and style tokens of ``style_dim`` channels."""


class DecoderConstants(NamedTuple):
    """Constants of a clip's decoding, computed once for all steps."""

    tokens: Sequence[Tensor | PreparedTokens]
    mask: Tensor | None
    rotation: Rotation | None


@decoder.register("style_transformer")
class StyleTransformer(Decoder):
    """Rotary Transformer in which every block attends to the style tokens; not autoregressive.

    Args:
        num_layers: blocks.
        num_heads: attention heads; ``dim / num_heads`` must be even for the rotary positions.
        feed_forward_factor: hidden width of the feed-forward as a multiple of ``dim``.
        dropout: dropout everywhere.
        final_norm: one more LayerNorm after the last block, usual for pre-norm blocks. The paper's figure has none, and
            without it the size of each frame's motion passes to the last map.
    """

    def __init__(
        self,
        *,
        dim: Width,
        style_dim: Width,
        num_layers: Annotated[int, Range(0, 256)] = 4,
        num_heads: Heads = 4,
        feed_forward_factor: Annotated[int, Range(1, 64)] = 4,
        dropout: Share = 0.1,
        final_norm: bool = True,
    ) -> None:
        super().__init__()
        self.blocks = nn.ModuleList(
            DecoderBlock(dim, style_dim, num_heads, feed_forward_factor * dim, dropout) for _ in range(num_layers)
        )
        self.norm = nn.LayerNorm(dim) if final_norm else nn.Identity()

    def forward(
        self, fused: Frames, style: Tokens, mask: FrameMask, prepared: DecoderConstants | None = None
    ) -> Frames:
        """F_dec of each frame."""
        if prepared is None:
            # Training: the attention of each block computes its keys and values from the tokens themselves.
            prepared = DecoderConstants([style] * len(self.blocks), mask, self._rotation(mask.shape[1]))
        for block, tokens in zip(self.blocks, prepared.tokens, strict=True):
            fused = block(fused, tokens, prepared.mask, prepared.rotation)
        return self.norm(fused)

    def prepare(self, style: Tokens, mask: FrameMask) -> DecoderConstants:
        """Each block's products of the style tokens, and the rotary positions that all blocks share."""
        tokens = [block.style_attention.prepare(style) for block in cast(Sequence[DecoderBlock], self.blocks)]
        return DecoderConstants(tokens, needed_mask(mask), self._rotation(mask.shape[1]))

    def _rotation(self, frames: int) -> Rotation | None:
        blocks = cast(Sequence[DecoderBlock], self.blocks)
        return blocks[0].time_attention.rotation(frames) if len(blocks) else None


class DecoderBlock(nn.Module):
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

    def forward(
        self, x: Tensor, style: Tensor | PreparedTokens, mask: Tensor | None, rotation: Rotation | None
    ) -> Tensor:
        """``x`` (batch, frames, dim), ``style`` (batch, tokens, style_dim), ``mask`` (batch, frames)."""
        # Pre-norm (Xiong et al. 2020): the residual path is never normalised, so that gradients reach the lower blocks
        # without warming up the learning rate.
        normed = self.time_norm(x)
        x = x + self.dropout(self.time_attention(normed, normed, mask, rotation))
        x = x + self.dropout(self.style_attention(self.style_norm(x), style))
        return x + self.dropout(self.feed_forward(self.feed_forward_norm(x)))


class TokenProducts(NamedTuple):
    """Keys and values of a few tokens with the attention's outer maps multiplied in.

    Attributes:
        keys: from a frame's features to its scores, (batch, dim, heads * tokens).
        offset: added to the scores, (batch, 1, heads * tokens).
        values: from the scores' softmax to the result, (batch, heads * tokens, dim).
    """

    keys: Tensor
    offset: Tensor
    values: Tensor


PreparedTokens = TokenProducts | AttentionContext
"""What an attention to a few tokens computes from them, once for all queries."""


class TokenAttention(Attention):
    """Attention to a few tokens, with the query's map multiplied into the keys and the last map into the values."""

    def forward(self, x: Frames, context: Float[Tensor, "batch keys context_dim"] | PreparedTokens) -> Frames:  # type: ignore[override]
        """Attend from ``x`` to all of ``context``, or to the result of :meth:`prepare` for it."""
        if isinstance(context, Tensor):
            context = self.prepare(context)
        if isinstance(context, AttentionContext):
            return self.attend(self.queries(x), context)
        # One product for all heads; the softmax is over each head's own tokens.
        # The scores arrive with W_q, b_q and 1/√d in them, and the values with W_o, so that neither queries nor a last
        # map are computed. Heads lie side by side in one matrix.
        scores = x @ context.keys + context.offset
        weights = scores.view(*scores.shape[:2], self.num_heads, -1).softmax(dim=-1).flatten(2)
        return weights @ context.values + self.out.bias

    def prepare(self, context: Float[Tensor, "batch keys context_dim"]) -> PreparedTokens:
        """What does not depend on the queries: the products, or keys and values where there are too many tokens."""
        # The scores (W_q x + b_q)·k and the mixture Σ_k a_k W_o v_k are the same numbers in another order. For fewer
        # than ``dim`` pairs of head and token, two narrow products replace two of ``dim`` by ``dim`` per frame.
        dim = self.query.in_features
        key, value = pairs = self.keys_values(context)
        if self.num_heads * context.shape[1] >= dim:
            return pairs
        key = key / math.sqrt(key.shape[-1])
        # The maps by head, (heads, head_dim, dim); the bias of W_q becomes the offset, W_o's is added last.
        into = self.query.weight.view(self.num_heads, -1, dim)
        out = self.out.weight.T.reshape(self.num_heads, -1, dim)
        keys = (key @ into).flatten(1, 2).transpose(1, 2)
        offset = (key @ self.query.bias.view(self.num_heads, -1, 1)).flatten(1)[:, None]
        return TokenProducts(keys, offset, (value @ out).flatten(1, 2))


class GruConstants(NamedTuple):
    """Constants of a clip's decoding, computed once for all steps."""

    lengths: Tensor
    scale: Tensor
    shift: Tensor


@decoder.register("gru")
class GruDecoder(Decoder):
    """Gated recurrent units over time, the form of FaceDiffuser, scaled and shifted by the mean style token.

    Args:
        num_layers: recurrent layers.
        bidirectional: also read the sequence backwards (needs an even ``dim``).
        dropout: dropout between recurrent layers.
    """

    graph_takes_padding = False

    def __init__(
        self,
        *,
        dim: Width,
        style_dim: Width,
        num_layers: Layers = 2,
        bidirectional: bool = True,
        dropout: Share = 0.1,
    ) -> None:
        super().__init__()
        if bidirectional and dim % 2:
            raise ArgumentError({"dim": dim, "bidirectional": True}, "dim must be even for a bidirectional decoder")
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

    def forward(self, fused: Frames, style: Tokens, mask: FrameMask, prepared: GruConstants | None = None) -> Frames:
        """F_dec of each frame."""
        lengths, scale, shift = self.prepare(style, mask) if prepared is None else prepared
        # A residual around the recurrent layers, and the style last, as in FaceDiffuser, where the style scales the
        # states before the last map.
        return torch.addcmul(shift, self.norm(all_states(self.gru, fused, lengths) + fused), scale)

    def prepare(self, style: Tokens, mask: FrameMask) -> GruConstants:
        """The lengths, for which the device must be waited for, and the modulation by the style."""
        # The mean of the tokens has no order and no number of them, so that any style encoder fits. 1 + scale is the
        # identity for small weights: an untrained style changes hardly anything.
        scale, shift = self.modulation(style.mean(1, keepdim=True)).chunk(2, dim=-1)
        lengths = mask.sum(1)
        return GruConstants(lengths if exporting() else lengths.cpu(), 1 + scale, shift)
