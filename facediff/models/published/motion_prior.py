"""A discrete prior of facial motion: an autoencoder with frames of a few entries each of a learnt table of codes.

The first stage of CodeTalker. Motion goes through two coders that are built alike (:class:`PriorCoder`); between them,
every frame's vector is cut into tokens, and each token becomes the nearest code. Both coders attend to all frames of a
clip and normalise over them, so clips of different lengths never go through them together.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.models.audio_encoders import by_length
from facediff.models.published.positions import periodic_positions


class PriorBlock(nn.Module):
    """Self-attention over all frames, then a feed-forward layer; each normalises its input and is added.

    Its sizes are options of ``CodeTalker``.
    """

    def __init__(self, dim: int, num_heads: int, hidden_dim: int, *, corrected: bool) -> None:
        super().__init__()
        self.num_heads = num_heads
        # Published: h^−0.5 of the whole width 1024, where a head has 128 channels. The scores are √8 times smaller than
        # usual and the attention flatter; the released weights were trained with it.
        self.scale = (dim // num_heads if corrected else dim) ** -0.5
        self.attention_norm, self.hidden_norm = nn.LayerNorm(dim), nn.LayerNorm(dim)
        self.project = nn.Linear(dim, 3 * dim, bias=False)
        self.out = nn.Linear(dim, dim)
        self.first, self.second = nn.Linear(dim, hidden_dim), nn.Linear(hidden_dim, dim)

    def forward(
        self, x: Float[Tensor, "batch frames dim"], newest: int | None = None
    ) -> Float[Tensor, "batch newest dim"]:
        """The frames, or only the last ``newest`` of them, which attend to all."""
        normed, dim = self.attention_norm(x), x.shape[-1]
        last = slice(0 if newest is None else x.shape[1] - newest, None)
        # In generation only the newest frame is wanted of the last layer, so only its query is projected; keys and
        # values are still of all frames, since the normalisation before has changed all of them.
        if newest is None:
            query, key, value = self.project(normed).chunk(3, -1)
        else:
            query = F.linear(normed[:, last], self.project.weight[:dim])
            key, value = F.linear(normed, self.project.weight[dim:]).chunk(2, -1)
        query, key, value = (x.unflatten(-1, (self.num_heads, -1)).transpose(1, 2) for x in (query, key, value))
        mixed = F.scaled_dot_product_attention(query, key, value, scale=self.scale)
        x = x[:, last] + self.out(mixed.transpose(1, 2).flatten(2))
        return x + self.second(F.gelu(self.first(self.hidden_norm(x)), approximate="tanh"))


class PriorCoder(nn.Module):
    """One half of the autoencoder: a convolution over time, and Transformer layers.

    Its sizes are options of ``CodeTalker``.
    """

    def __init__(
        self,
        *,
        dim: int,
        num_layers: int,
        num_heads: int,
        hidden_dim: int,
        leak: float,
        corrected: bool,
    ) -> None:
        super().__init__()
        self.leak, self.corrected = leak, corrected
        # Replicated edges, as published: zeros would pull a clip's first and last frames towards the face at rest.
        self.smooth = nn.Conv1d(dim, dim, 5, padding=2, padding_mode="replicate")
        self.embed = nn.Linear(dim, dim)
        self.blocks = nn.ModuleList(
            PriorBlock(dim, num_heads, hidden_dim, corrected=corrected) for _ in range(num_layers)
        )

    def forward(
        self, x: Float[Tensor, "batch frames dim"], newest: int | None = None
    ) -> Float[Tensor, "batch newest dim"]:
        """All frames of clips of one length; or only the last ``newest`` frames of the result."""
        frames, dim = x.shape[1:]
        smooth = F.leaky_relu(self.smooth(x.transpose(1, 2)), self.leak)
        # Instance normalisation: over a clip's frames, for each channel. Written as a layer norm over time, which takes
        # a single frame as well: zeros come of it, as they do of two equal frames.
        x = self.embed(F.layer_norm(smooth, (frames,)).transpose(1, 2))
        # The published table is indexed by the batch's size, 1 at inference, so that every frame gets row 0. The
        # released weights need this.
        count = frames if self.corrected else 1
        x = x + periodic_positions(count, dim, count, device=x.device)
        for block in self.blocks[:-1]:
            x = block(x)
        return self.blocks[-1](x, newest)


class Codes(NamedTuple):
    """Tokens and the codes nearest to them."""

    values: Float[Tensor, "batch frames width"]
    entries: Float[Tensor, "batch frames width"]
    numbers: Int[Tensor, "batch frames tokens"]


class MotionPrior(nn.Module):
    """Motion as tokens of a table of codes, and back.

    Its sizes are options of ``CodeTalker``.
    """

    def __init__(
        self,
        *,
        coordinates: int,
        dim: int,
        tokens: int,
        token_dim: int,
        codes: int,
        token_maps: bool,
        out_bias: bool,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__()
        self.tokens, self.width = tokens, tokens * token_dim
        self.motion_in = nn.Linear(coordinates, dim)
        self.encoder = PriorCoder(dim=dim, **options)
        self.to_tokens = nn.Linear(dim, self.width) if token_maps else nn.Identity()
        # Uniform in ±1/codes, as in the public VQ-VAE implementations that the released code follows: all codes start
        # so close that every one of them has a chance of being the nearest.
        self.codebook = nn.Parameter(torch.empty(codes, token_dim).uniform_(-1 / codes, 1 / codes))
        self.from_tokens = nn.Linear(self.width, dim) if token_maps else nn.Identity()
        self.decoder = PriorCoder(dim=dim, **options)
        self.motion_out = nn.Linear(dim, coordinates, bias=out_bias)

    def encode(self, motion: Float[Tensor, "batch frames coordinates"]) -> Float[Tensor, "batch frames width"]:
        """Tokens of clips of one length, not yet codes."""
        return self.to_tokens(self.encoder(F.leaky_relu(self.motion_in(motion), self.encoder.leak)))

    def quantise(self, tokens: Float[Tensor, "batch frames width"]) -> Codes:
        """The code nearest to each token; the first of several that are equally near."""
        with torch.autocast(tokens.device.type, enabled=False):  # codes that are near each other must stay apart
            tokens = tokens.float()
            flat = tokens.reshape(-1, self.codebook.shape[1])
            # |z|² + |e|² − 2 z·e in the published order of terms: another order rounds differently, a near tie gives
            # another code, and all frames that follow differ from it on.
            distances = flat.square().sum(1, keepdim=True) + self.codebook.square().sum(1) - 2 * flat @ self.codebook.T
            numbers = distances.argmin(1)
            entries = self.codebook[numbers].view(tokens.shape)
            # The straight-through estimator: the value is the code's, the gradient the token's, since the choice of a
            # code has no derivative.
            values = tokens + (entries - tokens).detach()
        return Codes(values, entries, numbers.view(*tokens.shape[:2], self.tokens))

    def decode(self, values: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch frames coordinates"]:
        """Motion of clips of one length."""
        return self.motion_out(self.decoder(self.from_tokens(values)))

    def decode_last(self, values: Float[Tensor, "batch frames width"]) -> Float[Tensor, "batch coordinates"]:
        """The last frame of what :meth:`decode` gives, without what only the other frames need."""
        return self.motion_out(self.decoder(self.from_tokens(values), 1))[:, 0]

    def encode_clips(self, motion: Tensor, frames: Int[Tensor, " batch"]) -> Tensor:
        """Tokens of padded clips (B, T, 3V), each as if it were alone."""
        return by_length(motion, frames, self.encode)[0]

    def decode_clips(self, values: Tensor, frames: Int[Tensor, " batch"]) -> Tensor:
        """Motion of padded clips of codes, each as if it were alone."""
        return by_length(values, frames, self.decode)[0]


def perplexity(numbers: Int[Tensor, " tokens"], codes: int) -> Float[Tensor, ""]:
    """How many codes are in use: e to the entropy of their shares."""
    shares = torch.bincount(numbers, minlength=codes) / max(1, len(numbers))
    return torch.special.entr(shares).sum().exp()
