"""Encoders of a speaker: identity encoders (dual-path paper, section 1.3.2) and style encoders (section 1.3.1).

An identity encoder turns a label into the static feature F_id, a style encoder turns a reference motion into the
dynamic feature F_dyn. The ablation ``none`` of either contributes nothing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Annotated, Literal, Protocol

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn.utils.parametrizations import weight_norm

from facediff.models.layers import (
    Attention,
    FeedForward,
    FrameMask,
    Frames,
    Heads,
    Layers,
    Share,
    Width,
    all_states,
    check_heads,
    exporting,
    interpolate_frames,
)
from facediff.registry import identity_encoder, style_encoder
from facediff.utils.ranges import Range

Count = Annotated[int, Range(1, 1_000_000)]
"""Identities of a model."""

StyleVectors = Float[Tensor, "batch style_dim"]
"""F_dyn of each clip."""


class IdentityEncoder(nn.Module, ABC):
    """An identity index to a static identity feature F_id.

    Attributes:
        token_dims: how F_id splits into style tokens, e.g. (C, C, C) for coarse, mid and fine; their sum is the
            width of F_id. Empty where the encoder contributes nothing.
    """

    token_dims: tuple[int, ...]

    @abstractmethod
    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """Encode."""


class IdentityEncoderFactory(Protocol):
    """Makes an identity encoder once the model's sizes are known."""

    def __call__(self, *, dim: int, n_identities: int) -> IdentityEncoder:
        """Make one for ``n_identities`` identities in a model of ``dim`` channels."""


@identity_encoder.register("hierarchical")
class HierarchicalIdentity(IdentityEncoder):
    """Coarse, mid and fine embedding of the identity, weighted by attention.

    [β_c, β_m, β_f] = softmax(W₂ [e_c; e_m; e_f] + b₂) (eq. 10);
    F_id = LayerNorm([β_c e_c; β_m e_m; β_f e_f]) (eq. 11).

    Args:
        level_dim: channels of each level; ``dim`` if None.
    """

    def __init__(self, *, dim: Width, n_identities: Count, level_dim: Width | None = None) -> None:
        super().__init__()
        width = dim if level_dim is None else level_dim
        self.coarse = nn.Embedding(n_identities, width)
        self.mid = nn.Embedding(n_identities, width)
        self.fine = nn.Embedding(n_identities, width)
        self.attention = nn.Linear(3 * width, 3)
        self.norm = nn.LayerNorm(3 * width)
        self.token_dims = (width, width, width)

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """F_id of each clip; an unseen speaker, or a hidden identity, gets the mean over all identities."""
        tables = [self.coarse.weight, self.mid.weight, self.fine.weight]
        weights = self.attention(torch.cat(tables, dim=-1)).softmax(-1).unbind(-1)  # eq. 10
        weighted = [weight[:, None] * table for weight, table in zip(weights, tables, strict=True)]
        features = self.norm(torch.cat(weighted, dim=-1))  # eq. 11
        return torch.where((identity >= 0)[:, None], features[identity.clamp_min(0)], features.mean(0)[None])


@identity_encoder.register("none")
class NoIdentity(IdentityEncoder):
    """No identity condition (ablation)."""

    def __init__(self, *, dim: Width, n_identities: Count) -> None:
        super().__init__()
        self.token_dims = ()

    def forward(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identity_dim"]:
        """A feature of width zero."""
        return identity.new_zeros((identity.shape[0], 0)).float()


class StyleEncoder(nn.Module, ABC):
    """A reference motion, embedded to ``dim`` channels per frame, to one dynamic style feature F_dyn.

    Attributes:
        token_dims: how F_dyn splits into style tokens; its sum is the width of F_dyn. Empty where the encoder
            contributes nothing.
    """

    token_dims: tuple[int, ...]

    @abstractmethod
    def forward(self, reference: Frames, mask: FrameMask) -> StyleVectors:
        """Encode; frames where ``mask`` is False are padding and never count."""


class StyleEncoderFactory(Protocol):
    """Makes a style encoder once the model's width is known."""

    def __call__(self, *, dim: int) -> StyleEncoder:
        """Make one for references embedded to ``dim`` channels."""


@style_encoder.register("tcn_gru_transformer")
class TcnGruTransformer(StyleEncoder):
    """Five dilated TCN branches, Bi-GRU, Pre-Norm Transformer, attention pooling, MLP (eq. 2 to 9).

    The learnt position embedding P serves references of any length: it is a table of ``n_positions`` rows that is
    interpolated to each clip's own number of frames, so a row stands for a relative place in the clip.

    Args:
        dim: channels; given by the model. Must be even.
        dilations: dilation of each parallel TCN branch.
        kernel_size: taps of the TCN convolutions.
        causal: causal convolutions as in Bai et al. 2018; else centred ones.
        num_layers: Transformer layers (the paper's L).
        num_heads: attention heads.
        n_positions: rows of the position embedding.
        dropout: dropout everywhere.
        statistics: add a linear map of the features' means and deviations over the reference (not in the paper). How
            far and about what rest someone moves is in them; the other layers, each behind a normalisation, learn it
            late.
    """

    def __init__(
        self,
        *,
        dim: Width,
        dilations: Annotated[tuple[int, ...], Range(1, 1000, items=(1, 32))] = (1, 2, 4, 8, 16),
        kernel_size: Annotated[int, Range(1, 100)] = 3,
        causal: bool = True,
        num_layers: Annotated[int, Range(0, 256)] = 2,
        num_heads: Heads = 4,
        n_positions: Annotated[int, Range(1, 16_384)] = 64,
        dropout: Share = 0.1,
        statistics: bool = False,
    ) -> None:
        super().__init__()
        check_heads(dim=dim, num_heads=num_heads, even=True)
        self.branches = nn.ModuleList(
            TemporalBlock(dim, d, kernel_size, causal=causal, dropout=dropout) for d in dilations
        )
        self.gru = nn.GRU(dim, dim // 2, batch_first=True, bidirectional=True)
        # Small at the start, as usual for learnt positions, so that they do not drown the features.
        self.positions = nn.Parameter(torch.randn(n_positions, dim) * 0.02)
        self.layers = nn.ModuleList(EncoderLayer(dim, num_heads, dropout) for _ in range(num_layers))
        self.norm = nn.LayerNorm(dim)
        self.pooling = AttentionPooling(dim)
        self.mlp = nn.Sequential(nn.Linear(dim, dim), nn.GELU(), nn.Linear(dim, dim))
        self.statistics = nn.Linear(2 * dim, dim) if statistics else None
        self.token_dims = (dim,)

    def forward(self, reference: Frames, mask: FrameMask) -> StyleVectors:
        """F_dyn of each clip (eq. 9)."""
        column = mask[..., None].to(reference.dtype)
        lengths = mask.sum(1)
        x = torch.stack([branch(reference, column) for branch in self.branches]).mean(0)  # F_TCN, eq. 2
        x = all_states(self.gru, x, lengths if exporting() else lengths.cpu())  # eq. 3 to 5
        # The position embedding P, stretched to each clip's length, and the Transformer (eq. 6).
        # By relative place: a table of absolute positions would leave rows for long references untrained, and the
        # reference's length is chosen by the user.
        rows = torch.full_like(lengths, self.positions.shape[0])
        positions = interpolate_frames(self.positions.expand(lengths.shape[0], -1, -1), rows, lengths)
        x = x + nn.functional.pad(positions, (0, 0, 0, mask.shape[1] - positions.shape[1]))
        for layer in self.layers:
            x = layer(x, mask)
        style = self.mlp(self.pooling(self.norm(x), mask))
        return style if self.statistics is None else style + self.statistics(mean_and_deviation(reference, mask))


def mean_and_deviation(
    features: Frames, mask: FrameMask, epsilon: float = 1e-4
) -> Float[Tensor, "batch twice_the_channels"]:
    """Mean and standard deviation of features over each clip's valid frames; ``epsilon`` is added to the variance."""
    column = mask[..., None].to(features.dtype)
    count = column.sum(1).clamp_min(1)
    mean = (features * column).sum(1) / count
    variance = ((features - mean[:, None]) * column).square().sum(1) / count
    # Without it the gradient of the root is infinite at a reference that stands still.
    return torch.cat([mean, (variance + epsilon).sqrt()], -1)


class TemporalBlock(nn.Module):
    """Residual block of two dilated convolutions over time (Bai et al. 2018, figure 1b)."""

    def __init__(self, dim: int, dilation: int, kernel_size: int, *, causal: bool, dropout: float) -> None:
        super().__init__()
        reach = dilation * (kernel_size - 1)
        self.padding = (reach, 0) if causal else (reach // 2, reach - reach // 2)
        # Weight norm and ReLU as in Bai et al.'s block; batch norm in its place would make a clip's style depend on the
        # batch.
        self.first = weight_norm(nn.Conv1d(dim, dim, kernel_size, dilation=dilation))
        self.second = weight_norm(nn.Conv1d(dim, dim, kernel_size, dilation=dilation))
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``x`` (batch, frames, dim), ``mask`` (batch, frames, 1); padding is zero before each convolution."""
        hidden = x
        # Padding is zeroed before each convolution, so that a clip's last frames see the same as at a batch's end.
        for conv in (self.first, self.second):
            columns = nn.functional.pad((hidden * mask).transpose(1, 2), self.padding)
            hidden = self.dropout(torch.relu(conv(columns).transpose(1, 2)))
        return torch.relu(x + hidden)


class EncoderLayer(nn.Module):
    """Pre-norm Transformer encoder layer."""

    def __init__(self, dim: int, num_heads: int, dropout: float) -> None:
        super().__init__()
        self.attention_norm = nn.LayerNorm(dim)
        self.attention = Attention(dim, dim, num_heads, dropout=dropout)
        self.feed_forward_norm = nn.LayerNorm(dim)
        self.feed_forward = FeedForward(dim, 4 * dim, dropout)
        self.dropout = nn.Dropout(dropout)

    def forward(self, x: Tensor, mask: Tensor) -> Tensor:
        """``x`` (batch, frames, dim), ``mask`` (batch, frames)."""
        normed = self.attention_norm(x)
        x = x + self.dropout(self.attention(normed, normed, mask))
        return x + self.dropout(self.feed_forward(self.feed_forward_norm(x)))


class AttentionPooling(nn.Module):
    """One vector from a sequence: γ_t = softmax_t(w_aᵀ tanh(W₁ f_t + b₁)), s = Σ_t γ_t f_t (eq. 7 and 8)."""

    def __init__(self, dim: int) -> None:
        super().__init__()
        self.hidden = nn.Linear(dim, dim)
        self.score = nn.Linear(dim, 1, bias=False)

    def forward(self, features: Frames, mask: FrameMask) -> Float[Tensor, "batch dim"]:
        """The weighted mean s; γ is exactly zero on padding."""
        # −∞ before the softmax gives padding a weight of exactly zero.
        score = self.score(torch.tanh(self.hidden(features))).squeeze(-1)
        return torch.einsum("bt,btc->bc", score.masked_fill(~mask, -torch.inf).softmax(-1), features)


@style_encoder.register("lstm")
class LstmStyle(StyleEncoder):
    """Last state of an LSTM that reads the frames in order (Chai et al., style-content disentanglement).

    Args:
        style_dim: channels of the style.
        num_layers: recurrent layers.
        pooling: the ``last`` state, as in the published work, or the ``mean`` of the states over all frames, which
            forgets less of a long reference.
    """

    def __init__(
        self, *, dim: Width, style_dim: Width = 32, num_layers: Layers = 1, pooling: Literal["last", "mean"] = "last"
    ) -> None:
        super().__init__()
        self.lstm = nn.LSTM(dim, style_dim, num_layers, batch_first=True)
        self.pooling = pooling
        self.token_dims = (style_dim,)

    def forward(self, reference: Frames, mask: FrameMask) -> StyleVectors:
        """The state after each clip's last frame."""
        # Padding comes after all valid frames; zeros keep NaN and infinity there out of the gradient.
        states = all_states(self.lstm, reference.masked_fill(~mask[..., None], 0.0))
        if self.pooling == "mean":
            return (states * mask[..., None]).sum(1) / mask.sum(1)[:, None].clamp_min(1)
        last = mask.sum(1) - 1
        return states[torch.arange(states.shape[0], device=states.device), last]


@style_encoder.register("none")
class NoStyle(StyleEncoder):
    """No dynamic style condition (ablation)."""

    def __init__(self, *, dim: Width) -> None:
        super().__init__()
        self.token_dims = ()

    def forward(self, reference: Frames, mask: FrameMask) -> StyleVectors:
        """A feature of width zero."""
        return reference.new_zeros((reference.shape[0], 0))
