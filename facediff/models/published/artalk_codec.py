"""ARTalk's codec: motion of 100 frames as bits at several rates in time, and back.

Each rate's bits are the signs of the coarser rates' residual (residual binary spherical quantisation, Zhao et al.
2024, "Image and video tokenization with binary spherical quantization").
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

Bits = Int[Tensor, "batch tokens code_dim"]


class CodecAttention(nn.Module):
    """Self-attention of normalised frames, divided by the square root of the whole width.

    Its sizes are options of ``ARTalk``.
    """

    def __init__(self, dim: int, num_heads: int) -> None:
        super().__init__()
        self.num_heads = num_heads
        self.norm = nn.LayerNorm(dim)
        self.to_qkv = nn.Linear(dim, 3 * dim, bias=False)
        self.to_out = nn.Linear(dim, dim)

    def forward(self, x: Float[Tensor, "batch frames dim"], mask: Tensor) -> Float[Tensor, "batch frames dim"]:
        """The block's update of the frames."""
        query, key, value = self.to_qkv(self.norm(x)).unflatten(2, (3, self.num_heads, -1)).permute(2, 0, 3, 1, 4)
        # Published: by the width of all heads together, and not of one.
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=mask, scale=x.shape[2] ** -0.5)
        result: Tensor = self.to_out(mixed.transpose(1, 2).flatten(2))
        return result


class CodecTransformer(nn.Module):
    """A linear map, layers of attention and maps of each frame, a linear map.

    Its sizes are options of ``ARTalk``.
    """

    def __init__(self, in_dim: int, dim: int, out_dim: int, depth: int, num_heads: int) -> None:
        super().__init__()
        self.first = nn.Sequential(nn.Linear(in_dim, dim), nn.LeakyReLU(0.2))
        hidden = int(1.5 * dim)
        self.blocks = nn.ModuleList()
        for _ in range(depth):
            self.blocks.append(CodecAttention(dim, num_heads))
            self.blocks.append(nn.Sequential(nn.Linear(dim, hidden), nn.GELU("tanh"), nn.Linear(hidden, dim)))
        self.last = nn.Linear(dim, out_dim)

    def forward(self, x: Float[Tensor, "batch frames in_dim"], mask: Tensor) -> Float[Tensor, "batch frames out_dim"]:
        """All frames; ``mask`` is added to the scores of attention."""
        x = self.first(x)
        for block in self.blocks:
            x = x + (block(x, mask) if isinstance(block, CodecAttention) else block(x))
        result: Tensor = self.last(x)
        return result


class BitCodec(nn.Module):
    """Motion to bits and back, each chunk together with the one before it.

    Its sizes are options of ``ARTalk``.
    """

    mask: Tensor
    motion_mean: Tensor
    motion_std: Tensor

    def __init__(
        self,
        channels: int,
        scales: Sequence[int],
        code_dim: int = 32,
        dim: int = 512,
        depth: int = 8,
        num_heads: int = 8,
    ) -> None:
        super().__init__()
        self.scales, self.code_dim, self.frames = tuple(scales), code_dim, scales[-1]
        self.encoder = CodecTransformer(channels, dim, code_dim, depth, num_heads)
        self.decoder = CodecTransformer(code_dim, dim, channels, depth, num_heads)
        self.encoder_positions = nn.Parameter(torch.randn(1, 2 * self.frames, channels) / math.sqrt(3 * channels))
        self.decoder_positions = nn.Parameter(torch.randn(1, 2 * self.frames, code_dim) / math.sqrt(3 * code_dim))
        self.register_buffer("motion_mean", torch.zeros(channels))
        self.register_buffer("motion_std", torch.ones(channels))
        # The chunk before is seen and does not see.
        mask = torch.zeros(2 * self.frames, 2 * self.frames)
        mask[: self.frames, self.frames :] = -torch.inf
        self.register_buffer("mask", mask, persistent=False)

    def encode(self, motion: Float[Tensor, "batch frames channels"]) -> Float[Tensor, "batch frames code_dim"]:
        """Codes of one chunk, or of two that follow each other, before they become bits."""
        frames = motion.shape[1]
        standard = (motion - self.motion_mean) / self.motion_std
        codes: Tensor = self.encoder(standard + self.encoder_positions[:, :frames], self.mask[:frames, :frames])
        return codes

    def quantise(
        self, codes: Float[Tensor, "batch frames code_dim"], flipped: float = 0.0
    ) -> tuple[Float[Tensor, "batch frames code_dim"], Bits, Tensor]:
        """The decoded codes, the bits of all rates, and how far codes are from them (commitment).

        Args:
            codes: of a chunk.
            flipped: share of the bits that are turned over, so that finer rates learn to mend coarser ones.
        """
        total, left, bits, distances = torch.zeros_like(codes), codes, [], []
        for scale in self.scales:
            unit = F.normalize(resized(left, scale, "area"), dim=2)
            signs = torch.where(unit > 0, 1.0, -1.0)
            distances.append((signs / math.sqrt(self.code_dim) - unit).square().sum(2).mean())
            if flipped:
                signs = torch.where(torch.rand_like(signs) < flipped, -signs, signs)
            # The gradient of bits is the codes' (straight through).
            stands = unit + (signs / math.sqrt(self.code_dim) - unit).detach()
            stands = resized(stands, self.frames, "linear")
            left, total = left - stands.detach(), total + stands
            bits.append((signs > 0).long())
        return total, torch.cat(bits, 1), torch.stack(distances).mean()

    def bits_of(self, motion: Float[Tensor, "batch frames channels"]) -> Bits:
        """Bits of a chunk by itself."""
        return self.quantise(self.encode(motion))[1]

    def sums(self, bits: Bits) -> list[Float[Tensor, "batch frames code_dim"]]:
        """Codes of the bits of the first rate, of the first two, and so on as far as there are bits."""
        values = (2.0 * bits - 1.0) / math.sqrt(self.code_dim)
        start, total, result = 0, torch.zeros((), device=bits.device), []
        for scale in self.scales:
            if start >= bits.shape[1]:
                break
            total = total + resized(values[:, start : start + scale], self.frames, "linear")
            result.append(total)
            start += scale
        return result

    def inputs_of_next(self, bits: Bits) -> Float[Tensor, "batch tokens code_dim"]:
        """For every rate but the first: the codes of the coarser ones, at its own rate."""
        sums = self.sums(bits)[: len(self.scales) - 1]
        return torch.cat([resized(total, self.scales[i + 1], "area") for i, total in enumerate(sums)], 1)

    def decode(self, before: Bits, bits: Bits) -> tuple[Tensor, Tensor]:
        """Motion (B, frames, channels) of two chunks that follow each other."""
        codes = torch.cat([self.sums(before)[-1], self.sums(bits)[-1]], 1)
        return self.decode_codes(codes)

    def decode_codes(self, codes: Float[Tensor, "batch frames code_dim"]) -> tuple[Tensor, Tensor]:
        """Motion of two chunks from what their bits stand for."""
        motion = self.decoder(codes + self.decoder_positions, self.mask) * self.motion_std + self.motion_mean
        return motion[:, : self.frames], motion[:, self.frames :]


def resized(values: Float[Tensor, "batch tokens width"], tokens: int, mode: str) -> Float[Tensor, "batch other width"]:
    """Means of stretches (``area``), or linear interpolation, along time; as they are if nothing changes."""
    if values.shape[1] == tokens:
        return values
    return F.interpolate(values.transpose(1, 2), size=tokens, mode=mode).transpose(1, 2)
