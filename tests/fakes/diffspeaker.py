"""A tiny DiffSpeaker checkpoint in its authors' form, and what the published inference makes of it.

Written from the method's formulas with NumPy and torch's functional operations; it shares no code with the model.
Speech is (samples,), motion (frames, 3V).
"""

from __future__ import annotations

import math

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.fakes.published import (
    COORDINATES,
    HIDDEN,
    IDENTITIES,
    RATES,
    Drawn,
    State,
    attend,
    backbone_state,
    decoder_state,
    features_of,
    hidden_of,
    interpolated,
    layer_norm,
    linear,
    linear_state,
    positions,
    standardised,
)

HEADS = 4


def state(dataset: str, seed: int = 0, dim: int = 16, layers: int = 1, hidden: int | None = None) -> State:
    draw, period = Drawn(seed), RATES[dataset]
    made = backbone_state("audio_encoder.", draw)
    own = linear_state("audio_feature_map", dim, HIDDEN, draw) | linear_state("vertice_map", dim, COORDINATES, draw)
    own["PPE.pe"] = positions(period * (5000 // period + 1), dim, period)[None]
    own |= decoder_state("transformer_decoder.", dim, layers, draw, hidden)
    own |= linear_state("time_embedding.linear_1", layers * dim, HIDDEN, draw)
    own |= linear_state("time_embedding.linear_2", layers * dim, layers * dim, draw)
    # Small, since each step's result goes into the next one through nothing that would bound it.
    own["motion_decoder.weight"], own["motion_decoder.bias"] = draw(COORDINATES, dim, spread=0.1), draw(COORDINATES)
    own["obj_vector.weight"] = draw(len(IDENTITIES), layers * dim, spread=1.0)
    return made | {f"denoiser.{name}": value for name, value in own.items()}


def bias_of(frames: int, period: int) -> Tensor:
    table = np.zeros((HEADS, frames, 2 + frames))
    for head in range(HEADS):
        slope = 2.0 ** (-8 * (head + 1) / HEADS)
        for i in range(frames):
            for j in range(frames):
                table[head, i, 2 + j] = -slope * ((i - j) // period if j <= i else (j - i - 1) // period)
    return torch.from_numpy(table).float()


def moments_of(frames: int) -> Tensor:
    table = torch.full((frames, 2 + frames), -torch.inf)
    table[:, :2] = 0.0
    table[:, 2:].fill_diagonal_(0.0)
    return table


def denoised(s: State, noisy: Tensor, t: int, memory: Tensor, dataset: str, row: Tensor) -> Tensor:
    """Clean offsets (frames, 3V) from noisy ones."""
    s = {name.removeprefix("denoiser."): value for name, value in s.items()}
    frames, period, dim = len(noisy), RATES[dataset], memory.shape[1]
    half = s["time_embedding.linear_1.weight"].shape[1] // 2
    angle = t * torch.exp(-math.log(10_000) * torch.arange(half) / half)
    embedded = linear(torch.cat([torch.cos(angle), torch.sin(angle)]), s, "time_embedding.linear_1")
    embedded = linear(embedded * torch.sigmoid(embedded), s, "time_embedding.linear_2")
    x = linear(noisy, s, "vertice_map") + s["PPE.pe"][0, :frames]
    bias, moments = bias_of(frames, period), moments_of(frames)
    for j in range(len(row) // dim):
        name = f"transformer_decoder.layers.{j}"
        part = slice(j * dim, (j + 1) * dim)
        tokens = torch.stack([row[part], embedded[part]])

        def projected(x: Tensor, attention: str, third: int, name: str = name) -> Tensor:
            rows = slice(third * dim, (third + 1) * dim)
            weight, shift = (s[f"{name}.{attention}.in_proj_{kind}"][rows] for kind in ("weight", "bias"))
            return F.linear(x, weight, shift)

        normed = layer_norm(x, s, f"{name}.norm1")
        own = torch.cat([tokens, normed])
        q = projected(normed, "self_attn", 0)
        k, v = (projected(own, "self_attn", third) for third in (1, 2))
        x = x + linear(attend(q, k, v, HEADS, bias), s, f"{name}.self_attn.out_proj")
        q = projected(layer_norm(x, s, f"{name}.norm2"), "multihead_attn", 0)
        k, v = (projected(torch.cat([tokens, memory]), "multihead_attn", third) for third in (1, 2))
        x = x + linear(attend(q, k, v, HEADS, moments), s, f"{name}.multihead_attn.out_proj")
        inner = F.gelu(linear(layer_norm(x, s, f"{name}.norm3"), s, f"{name}.linear1"))
        x = x + linear(inner, s, f"{name}.linear2")
    return linear(x, s, "motion_decoder")


def signal_of() -> Tensor:
    return torch.cumprod(1 - torch.linspace(0.00085**0.5, 0.012**0.5, 1000) ** 2, 0)


def frames_of(steps: int, dataset: str) -> int:
    return int((steps / 50.0) * RATES[dataset])


def reference(
    s: State,
    speech: Tensor,
    dataset: str,
    identity: int,
    template: Tensor,
    noise: Tensor,
    *,
    steps: int = 50,
    corrected: bool = False,
    row: Tensor | None = None,
) -> Tensor:
    """Absolute vertices (frames, 3V) from the noise (frames, 3V)."""
    hidden = hidden_of(features_of(standardised(speech, 1e-7), s, "audio_encoder."), s, "audio_encoder.")
    frames = frames_of(len(hidden), dataset)
    memory = linear(interpolated(hidden, frames), s, "denoiser.audio_feature_map")
    row = s["denoiser.obj_vector.weight"][identity] if row is None else row
    signal, stride, x = signal_of(), 1000 // steps, noise
    for t in [stride * place + 1 for place in range(steps)][::-1]:
        clean = denoised(s, x, t, memory, dataset, row)
        before = signal[t - stride] if t >= stride else signal[0]
        estimate = (x - signal[t].sqrt() * clean) / (1 - signal[t]).sqrt() if corrected else clean
        x = before.sqrt() * clean + (1 - before).sqrt() * estimate
    x = x + template
    if dataset == "vocaset":
        smooth = x.clone()
        for i in range(1, frames - 1):
            smooth[i] = (x[i - 1] + x[i] + x[i + 1]) / 3
        x = smooth
    return x
