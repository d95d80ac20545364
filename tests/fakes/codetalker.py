"""Tiny checkpoints of CodeTalker's two stages in their authors' form, and what the published code makes of them.

Written from the formulas, as tests/fakes/published.py is; nothing here is facediff's.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from tests.fakes.published import (
    COORDINATES,
    HIDDEN,
    IDENTITIES,
    RATES,
    Drawn,
    State,
    backbone_state,
    decoded,
    decoder_state,
    features_of,
    hidden_of,
    layer_norm,
    linear,
    linear_state,
    norm_state,
    positions,
    resampled,
    standardised,
)

CODES, PRIOR_HEADS, PRIOR_BLOCKS = 12, 2, 2


def tokens_of_frame(dataset: str) -> int:
    """Codes of a frame."""
    return 2 if dataset == "biwi" else 4


def stage_one(dataset: str, seed: int = 0, dim: int = 16) -> State:
    draw, made = Drawn(seed), {}
    width = dim // tokens_of_frame(dataset)
    made |= linear_state("encoder.vertice_mapping.0", dim, COORDINATES, draw)
    for half, smooth in (("encoder", "squasher"), ("decoder", "expander")):
        made |= {f"{half}.{smooth}.0.0.weight": draw(dim, dim, 5), f"{half}.{smooth}.0.0.bias": draw(dim, spread=0.1)}
        made |= linear_state(f"{half}.{half}_linear_embedding.net", dim, dim, draw)
        angle = np.outer(np.arange(50), 10_000.0 ** (-np.arange(0, dim, 2) / dim))
        table = np.stack([np.sin(angle), np.cos(angle)], -1).reshape(50, 1, dim)
        made[f"{half}.{half}_pos_embedding.pe"] = torch.from_numpy(table).float()
        for i in range(PRIOR_BLOCKS):
            first, second = (f"{half}.{half}_transformer.net.{2 * i + part}.fn" for part in (0, 1))
            made |= norm_state(f"{first}.norm", dim, draw) | norm_state(f"{second}.norm", dim, draw)
            made |= linear_state(f"{first}.fn.to_qkv", 3 * dim, dim, draw, bias=False)
            made |= linear_state(f"{first}.fn.to_out", dim, dim, draw)
            made |= linear_state(f"{second}.fn.l1", 24, dim, draw) | linear_state(f"{second}.fn.l2", dim, 24, draw)
    if dataset == "biwi":
        made |= linear_state("encoder.encoder_linear_embedding_post.net", dim, dim, draw)
        made |= linear_state("decoder.decoder_linear_embedding_pre.net", dim, dim, draw)
    made |= linear_state("decoder.vertice_map_reverse", COORDINATES, dim, draw, bias=dataset != "biwi")
    return made | {"quantize.embedding.weight": draw(CODES, width, spread=1.0)}


def stage_two(dataset: str, seed: int = 1, dim: int = 16, code_width: int = 16) -> State:
    draw, period = Drawn(seed), RATES[dataset]
    made = backbone_state("audio_encoder.", draw)
    made |= linear_state("audio_feature_map", dim, HIDDEN, draw) | linear_state("vertice_map", dim, COORDINATES, draw)
    made["PPE.pe"] = positions(period * (600 // period + 1), dim, period)[None]
    made |= decoder_state("transformer_decoder.", dim, 2, draw)
    made |= linear_state("feat_map", code_width, dim, draw, bias=False)
    return made | {"learnable_style_emb.weight": draw(len(IDENTITIES), dim, spread=1.0)}


def half_of_prior(x: Tensor, s: State, half: str, slope: float, scaled_by: str, place: str) -> Tensor:
    """Convolution, normalisation over frames and Transformer of the encoder or the decoder: (frames, dim)."""
    smooth = f"{half}.{'squasher' if half == 'encoder' else 'expander'}.0.0"
    spread = torch.cat([x[:1], x[:1], x, x[-1:], x[-1:]])
    kernel = s[f"{smooth}.weight"]
    x = sum((spread[k : k + len(x)] @ kernel[:, :, k].T for k in range(5)), s[f"{smooth}.bias"])
    x = torch.where(x < 0, slope * x, x)
    x = (x - x.mean(0)) / (x.var(0, unbiased=False) + 1e-5).sqrt()
    table = s[f"{half}.{half}_pos_embedding.pe"][:, 0]
    x = linear(x, s, f"{half}.{half}_linear_embedding.net") + (table[0] if place == "constant" else table[: len(x)])
    dim = x.shape[1]
    for i in range(PRIOR_BLOCKS):
        first, second = (f"{half}.{half}_transformer.net.{2 * i + part}.fn" for part in (0, 1))
        q, k, v = linear(layer_norm(x, s, f"{first}.norm"), s, f"{first}.fn.to_qkv").split(dim, 1)
        mixed = []
        for part in np.split(np.arange(dim), PRIOR_HEADS):
            root = math.sqrt(dim if scaled_by == "width" else dim / PRIOR_HEADS)
            mixed.append((q[:, part] @ k[:, part].T / root).softmax(-1) @ v[:, part])
        x = x + linear(torch.cat(mixed, 1), s, f"{first}.fn.to_out")
        inner = linear(layer_norm(x, s, f"{second}.norm"), s, f"{second}.fn.l1")
        inner = 0.5 * inner * (1 + torch.tanh(math.sqrt(2 / math.pi) * (inner + 0.044715 * inner**3)))
        x = x + linear(inner, s, f"{second}.fn.l2")
    return x


def encoded(motion: Tensor, s: State, slope: float = 0.2, **how: str) -> Tensor:
    """Tokens (frames, all tokens' channels) of offsets."""
    x = linear(motion, s, "encoder.vertice_mapping.0")
    x = half_of_prior(torch.where(x < 0, slope * x, x), s, "encoder", slope, **(PUBLISHED | how))
    post = "encoder.encoder_linear_embedding_post.net"
    return linear(x, s, post) if f"{post}.weight" in s else x


def quantised(x: Tensor, s: State) -> tuple[Tensor, float]:
    """Codes in place of tokens, and by how much the nearest was nearer than any other, at least."""
    table = s["quantize.embedding.weight"]
    rows = x.reshape(-1, table.shape[1])
    distance = torch.stack([(row - table).square().sum(1) for row in rows])
    two = distance.sort(1).values[:, :2]
    return table[distance.argmin(1)].reshape(x.shape), float((two[:, 1] - two[:, 0]).min())


def decoded_motion(codes: Tensor, s: State, slope: float = 0.2, **how: str) -> Tensor:
    """Offsets (frames, 3V) of codes."""
    pre = "decoder.decoder_linear_embedding_pre.net"
    x = linear(codes, s, pre) if f"{pre}.weight" in s else codes
    return linear(half_of_prior(x, s, "decoder", slope, **(PUBLISHED | how)), s, "decoder.vertice_map_reverse")


PUBLISHED = {"scaled_by": "width", "place": "constant"}
"""The prior as published."""


def reference(
    one: State, two: State, speech: Tensor, dataset: str, identity: int, template: Tensor
) -> tuple[Tensor, float]:
    """Absolute vertices (frames, 3V), everything anew for each frame; and how near a tie any code was."""
    features, frames = resampled(features_of(standardised(speech, 1e-5), two, "audio_encoder."), dataset)
    memory = linear(hidden_of(features, two, "audio_encoder."), two, "audio_feature_map")
    style, table = two["learnable_style_emb.weight"][identity], two["PPE.pe"][0]
    tokens, margin = style[None], math.inf
    for i in range(frames):
        made = decoded(tokens + table[: i + 1], memory, two, "transformer_decoder.", dataset)
        codes, gap = quantised(linear(made, two, "feat_map"), one)
        margin = min(margin, gap)
        # A single frame is given twice, and the first of both is taken.
        last = decoded_motion(codes, one)[-1] if i else decoded_motion(codes.repeat(2, 1), one)[0]
        tokens = torch.cat([tokens, linear(last[None], two, "vertice_map") + style])
    return decoded_motion(codes, one) + template, margin
