"""Tiny checkpoints in the form of the methods' authors, and what the published inference makes of them.

The references are written from the methods' formulas with torch's functional operations on the authors' tensors; they
share no code with facediff's models. Speech is (samples,), motion (frames, 3V).
"""

from __future__ import annotations

import json
import math
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

State = dict[str, Tensor]
VERTICES, HIDDEN, CHANNELS, LAYERS, HEADS = 12, 16, 8, 2, 2
COORDINATES = 3 * VERTICES
IDENTITIES = ["A", "B", "C"]
KERNELS, STRIDES = (10, 3, 3, 3, 3, 2, 2), (5, 2, 2, 2, 2, 2, 2)
AUDIO_CONFIG: dict[str, Any] = {"num_attention_heads": HEADS, "hidden_dropout": 0.0}
RATES = {"vocaset": 30, "biwi": 25}


class Drawn:
    """Random tensors, small enough that nothing saturates."""

    def __init__(self, seed: int = 0) -> None:
        self.generator = torch.Generator().manual_seed(seed)

    def __call__(self, *shape: int, spread: float | None = None, shift: float = 0.0) -> Tensor:
        spread = 1.0 / math.sqrt(math.prod(shape[1:]) or 1) if spread is None else spread
        return shift + spread * torch.randn(*shape, generator=self.generator)


def linear_state(prefix: str, out: int, into: int, draw: Drawn, *, bias: bool = True) -> State:
    made = {f"{prefix}.weight": draw(out, into)}
    return made | ({f"{prefix}.bias": draw(out, spread=0.1)} if bias else {})


def norm_state(prefix: str, width: int, draw: Drawn) -> State:
    return {f"{prefix}.weight": draw(width, spread=0.1, shift=1.0), f"{prefix}.bias": draw(width, spread=0.1)}


def backbone_state(prefix: str, draw: Drawn, *, large: bool = False) -> State:
    """A wav2vec 2.0 or HuBERT by the names of transformers 4, of the base or of the large form."""
    made: State = {f"{prefix}masked_spec_embed": draw(HIDDEN, spread=1.0)}
    for i, kernel in enumerate(KERNELS):
        layer = f"{prefix}feature_extractor.conv_layers.{i}"
        made[f"{layer}.conv.weight"] = draw(CHANNELS, CHANNELS if i else 1, kernel)
        if large:
            made[f"{layer}.conv.bias"] = draw(CHANNELS, spread=0.1)
        if large or i == 0:
            made |= norm_state(f"{layer}.layer_norm", CHANNELS, draw)
    made |= norm_state(f"{prefix}feature_projection.layer_norm", CHANNELS, draw)
    made |= linear_state(f"{prefix}feature_projection.projection", HIDDEN, CHANNELS, draw)
    position = f"{prefix}encoder.pos_conv_embed.conv"
    made |= {f"{position}.bias": draw(HIDDEN, spread=0.1), f"{position}.weight_g": draw(1, 1, 16, shift=1.0)}
    made[f"{position}.weight_v"] = draw(HIDDEN, HIDDEN // 4, 16)
    made |= norm_state(f"{prefix}encoder.layer_norm", HIDDEN, draw)
    for j in range(LAYERS):
        layer = f"{prefix}encoder.layers.{j}"
        for name in ("k_proj", "v_proj", "q_proj", "out_proj"):
            made |= linear_state(f"{layer}.attention.{name}", HIDDEN, HIDDEN, draw)
        made |= norm_state(f"{layer}.layer_norm", HIDDEN, draw) | norm_state(f"{layer}.final_layer_norm", HIDDEN, draw)
        made |= linear_state(f"{layer}.feed_forward.intermediate_dense", 32, HIDDEN, draw)
        made |= linear_state(f"{layer}.feed_forward.output_dense", HIDDEN, 32, draw)
    return made


def linear(x: Tensor, s: State, name: str) -> Tensor:
    return F.linear(x, s[f"{name}.weight"], s.get(f"{name}.bias"))


def layer_norm(x: Tensor, s: State, name: str) -> Tensor:
    return F.layer_norm(x, x.shape[-1:], s[f"{name}.weight"], s[f"{name}.bias"], 1e-5)


def attend(query: Tensor, key: Tensor, value: Tensor, heads: int, bias: Tensor | float = 0.0) -> Tensor:
    """softmax(q kᵀ / √head_dim + bias) v, all (positions, dim)."""
    q, k, v = (x.reshape(len(x), heads, -1).transpose(0, 1) for x in (query, key, value))
    weights = (q @ k.transpose(1, 2) / math.sqrt(q.shape[-1]) + bias).softmax(-1)
    return (weights @ v).transpose(0, 1).flatten(1)


def standardised(speech: Tensor, epsilon: float) -> Tensor:
    return (speech - speech.mean()) / (speech.var(unbiased=False) + epsilon).sqrt()


def features_of(speech: Tensor, s: State, prefix: str) -> Tensor:
    """The convolutions: (steps, channels) of standardised speech."""
    x = speech[None, None]
    for i, stride in enumerate(STRIDES):
        name = f"{prefix}feature_extractor.conv_layers.{i}"
        x = F.conv1d(x, s[f"{name}.conv.weight"], s.get(f"{name}.conv.bias"), stride=stride)
        norm = f"{name}.layer_norm.weight"
        if f"{prefix}feature_extractor.conv_layers.1.layer_norm.weight" in s:
            x = F.layer_norm(x.transpose(1, 2), (CHANNELS,), s[norm], s[f"{name}.layer_norm.bias"]).transpose(1, 2)
        elif norm in s:
            x = F.group_norm(x, CHANNELS, s[norm], s[f"{name}.layer_norm.bias"])
        x = F.gelu(x)
    return x[0].T


def hidden_of(features: Tensor, s: State, prefix: str) -> Tensor:
    """Feature projection and Transformer: (steps, hidden)."""
    large = f"{prefix}feature_extractor.conv_layers.1.layer_norm.weight" in s
    projection = f"{prefix}feature_projection"
    x = linear(layer_norm(features, s, f"{projection}.layer_norm"), s, f"{projection}.projection")
    conv = f"{prefix}encoder.pos_conv_embed.conv"
    v = s[f"{conv}.weight_v"]
    weight = s[f"{conv}.weight_g"] * v / v.square().sum((0, 1), keepdim=True).sqrt()
    position = F.conv1d(x.T[None], weight, s[f"{conv}.bias"], padding=8, groups=4)[0, :, :-1].T
    x = x + F.gelu(position)
    norm = f"{prefix}encoder.layer_norm"
    x = x if large else layer_norm(x, s, norm)
    for j in range(LAYERS):
        name = f"{prefix}encoder.layers.{j}"

        def heard(x: Tensor, name: str = name) -> Tensor:
            q, k, v = (linear(x, s, f"{name}.attention.{part}_proj") for part in "qkv")
            return linear(attend(q, k, v, HEADS), s, f"{name}.attention.out_proj")

        def fed(x: Tensor, name: str = name) -> Tensor:
            inner = F.gelu(linear(x, s, f"{name}.feed_forward.intermediate_dense"))
            return linear(inner, s, f"{name}.feed_forward.output_dense")

        first, last = f"{name}.layer_norm", f"{name}.final_layer_norm"
        if large:
            x = x + heard(layer_norm(x, s, first))
            x = x + fed(layer_norm(x, s, last))
        else:
            x = layer_norm(x + heard(x), s, first)
            x = layer_norm(x + fed(x), s, last)
    return layer_norm(x, s, norm) if large else x


def interpolated(x: Tensor, frames: int) -> Tensor:
    """Linear in time, the first and the last frame on the first and the last step."""
    # The places i·(steps − 1)/(frames − 1) in single precision, as the published code has them.
    places = torch.arange(frames) * torch.tensor((len(x) - 1) / max(frames - 1, 1), dtype=torch.float32)
    low = places.floor().long().clamp(max=len(x) - 1)
    share = (places - low)[:, None].to(x)
    return x[low] * (1 - share) + x[(low + 1).clamp(max=len(x) - 1)] * share


def resampled(features: Tensor, dataset: str, frames: int | None = None) -> tuple[Tensor, int]:
    """Features for frames as FaceFormer, CodeTalker and TalkingStyle take them, and the number of frames."""
    if dataset == "biwi":
        count = len(features) // 2 if frames is None else frames
        return features[: 2 * count], count
    count = int((len(features) / 50.0) * 30) if frames is None else frames
    return interpolated(features, count), count


# The decoder of FaceFormer, CodeTalker and TalkingStyle.


def decoder_state(prefix: str, dim: int, layers: int, draw: Drawn, hidden: int | None = None) -> State:
    made: State = {}
    for j in range(layers):
        made |= unmasked_layer_state(f"{prefix}layers.{j}", dim, hidden or 2 * dim, draw, cross=True)
    return made


def positions(frames: int, dim: int, period: int) -> Tensor:
    angle = np.outer(np.arange(frames) % period, 10_000.0 ** (-np.arange(0, dim, 2) / dim))
    table = np.empty((frames, dim))
    table[:, 0::2], table[:, 1::2] = np.sin(angle), np.cos(angle)
    return torch.from_numpy(table).float()


def self_bias(frames: int, heads: int, period: int) -> Tensor:
    distance = np.subtract.outer(np.arange(frames), np.arange(frames))
    heads_bias = [-(2.0 ** (-8 * (h + 1) / heads)) * (distance // period) for h in range(heads)]
    return torch.from_numpy(np.where(distance < 0, -np.inf, np.stack(heads_bias))).float()


def own_moment(frames: int, steps: int, per_frame: int) -> Tensor:
    """0 where a frame may attend to a step of speech, −∞ elsewhere."""
    bias = torch.full((frames, steps), -torch.inf)
    for i in range(frames):
        bias[i, per_frame * i : per_frame * (i + 1)] = 0.0
    return bias


def decoded(tokens: Tensor, memory: Tensor, s: State, prefix: str, dataset: str, heads: int = 4) -> Tensor:
    """The layers over tokens (frames, dim) that have their positions already."""
    frames, dim = tokens.shape
    bias = self_bias(frames, heads, RATES[dataset])
    moment = own_moment(frames, len(memory), 2 if dataset == "biwi" else 1)
    layers = len({name.removeprefix(f"{prefix}layers.").split(".")[0] for name in s if name.startswith(prefix)})
    x = tokens
    for j in range(layers):
        name = f"{prefix}layers.{j}"

        def projected(x: Tensor, part: str, third: int, name: str = name) -> Tensor:
            rows = slice(third * dim, (third + 1) * dim)
            return F.linear(x, s[f"{name}.{part}.in_proj_weight"][rows], s[f"{name}.{part}.in_proj_bias"][rows])

        own = attend(*(projected(x, "self_attn", third) for third in range(3)), heads, bias)
        x = layer_norm(x + linear(own, s, f"{name}.self_attn.out_proj"), s, f"{name}.norm1")
        q = projected(x, "multihead_attn", 0)
        k, v = (projected(memory, "multihead_attn", third) for third in (1, 2))
        x = layer_norm(
            x + linear(attend(q, k, v, heads, moment), s, f"{name}.multihead_attn.out_proj"), s, f"{name}.norm2"
        )
        fed = linear(torch.relu(linear(x, s, f"{name}.linear1")), s, f"{name}.linear2")
        x = layer_norm(x + fed, s, f"{name}.norm3")
    return x


# FaceFormer.


def faceformer_state(dataset: str, seed: int = 0, dim: int = 16) -> State:
    draw, period = Drawn(seed), RATES[dataset]
    made = backbone_state("audio_encoder.", draw)
    made |= linear_state("audio_feature_map", dim, HIDDEN, draw) | linear_state("vertice_map", dim, COORDINATES, draw)
    made["PPE.pe"] = positions(period * (600 // period + 1), dim, period)[None]
    made |= decoder_state("transformer_decoder.", dim, 1, draw)
    made |= linear_state("vertice_map_r", COORDINATES, dim, draw)
    return made | linear_state("obj_vector", dim, len(IDENTITIES), draw, bias=False)


def autoregressive(
    s: State, speech: Tensor, style: Tensor, ends: tuple[str, str], dataset: str, frames: int | None, epsilon: float
) -> Tensor:
    """Offsets (frames, 3V), each frame from all earlier frames again; ``ends`` are layers out of and into tokens."""
    features, count = resampled(features_of(standardised(speech, epsilon), s, "audio_encoder."), dataset, frames)
    memory = linear(hidden_of(features, s, "audio_encoder."), s, "audio_feature_map")
    tokens, table = style[None], s["PPE.pe"][0]
    for i in range(count):
        made = decoded(tokens + table[: i + 1], memory, s, "transformer_decoder.", dataset)
        offsets = linear(made, s, ends[0])
        tokens = torch.cat([tokens, linear(offsets[-1:], s, ends[1]) + style])
    return offsets


def faceformer_reference(s: State, speech: Tensor, dataset: str, identity: int, template: Tensor) -> Tensor:
    """Absolute vertices (frames, 3V)."""
    style = s["obj_vector.weight"][:, identity]
    return autoregressive(s, speech, style, ("vertice_map_r", "vertice_map"), dataset, None, 1e-5) + template


# FaceDiffuser.


def facediffuser_state(steps: int, seed: int = 0, dim: int = 16) -> State:
    draw = Drawn(seed)
    made = backbone_state("audio_encoder.", draw)
    made |= linear_state("cond_projection", dim, 2 * HIDDEN, draw)
    made |= linear_state("input_projection.0", 2 * dim, COORDINATES, draw)
    made |= {"input_projection.1.weight": draw(1, 1, 9), "input_projection.1.bias": draw(1, spread=0.1)}
    made |= linear_state("time_mlp.0", dim, steps, draw) | norm_state("norm_cond", 3 * dim, draw)
    for layer, into in ((0, 3 * dim), (1, dim)):
        made |= {f"gru.weight_ih_l{layer}": draw(3 * dim, into), f"gru.weight_hh_l{layer}": draw(3 * dim, dim)}
        made |= {f"gru.bias_{part}_l{layer}": draw(3 * dim, spread=0.1) for part in ("ih", "hh")}
    made |= linear_state("final_layer", COORDINATES, dim, draw)
    return made | linear_state("obj_vector", dim, len(IDENTITIES), draw, bias=False)


def facediffuser_frames(samples: int, dataset: str) -> int:
    return int(samples / 16000 * RATES[dataset]) - 1


def facediffuser_denoised(
    s: State, noisy: Tensor, step: int, speech: Tensor, dataset: str, identity: int, template: Tensor
) -> Tensor:
    """Clean absolute vertices (frames, 3V) from noisy ones."""
    frames = len(noisy)
    hidden = hidden_of(features_of(standardised(speech, 1e-5), s, "audio_encoder."), s, "audio_encoder.")
    hidden = hidden[: 2 * frames] if dataset == "biwi" else interpolated(hidden, 2 * frames)
    audio = linear(hidden.reshape(frames, -1), s, "cond_projection")
    mixed = F.conv1d(
        linear(noisy, s, "input_projection.0")[:, None],
        s["input_projection.1.weight"],
        s["input_projection.1.bias"],
        padding=4,
    )
    motion = torch.relu(mixed[:, 0].unflatten(1, (-1, 2)).amax(2))
    one_hot = F.one_hot(torch.tensor(step), s["time_mlp.0.weight"].shape[1]).float()
    time = linear(one_hot, s, "time_mlp.0")
    time = time * torch.tanh(F.softplus(time))
    x = layer_norm(torch.cat([audio, motion, time.expand(frames, -1)], 1), s, "norm_cond")
    for layer in (0, 1):
        state, out = torch.zeros(s["gru.weight_hh_l0"].shape[1]), []
        for row in x:
            given = F.linear(row, s[f"gru.weight_ih_l{layer}"], s[f"gru.bias_ih_l{layer}"]).chunk(3)
            kept = F.linear(state, s[f"gru.weight_hh_l{layer}"], s[f"gru.bias_hh_l{layer}"]).chunk(3)
            reset, update = torch.sigmoid(given[0] + kept[0]), torch.sigmoid(given[1] + kept[1])
            new = torch.tanh(given[2] + reset * kept[2])
            state = (1 - update) * new + update * state
            out.append(state)
        x = torch.stack(out)
    return linear(x * s["obj_vector.weight"][:, identity], s, "final_layer") + template


def facediffuser_reference(
    s: State, speech: Tensor, dataset: str, identity: int, template: Tensor, seed: int, skip: int = 0
) -> Tensor:
    """Absolute vertices (frames, 3V) of the reverse process over all steps, by PyTorch's generator."""
    steps, frames = s["time_mlp.0.weight"].shape[1], facediffuser_frames(len(speech), dataset)
    generator = torch.Generator().manual_seed(seed)

    def bar(u: float) -> float:
        return math.cos((u + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = [min(1 - bar((i + 1) / steps) / bar(i / steps), 0.999) for i in range(steps)]
    signal = [math.prod(1 - beta for beta in betas[: i + 1]) for i in range(steps)]
    x = torch.randn(1, frames, COORDINATES, generator=generator)[0]
    start = steps - skip - 1
    x = math.sqrt(1 - signal[start]) * x if skip else x
    for t in range(start, -1, -1):
        clean = facediffuser_denoised(s, x, t, speech, dataset, identity, template)
        noise = torch.randn(1, frames, COORDINATES, generator=generator)[0]
        before = signal[t - 1] if t else 1.0
        x = (
            betas[t] * math.sqrt(before) / (1 - signal[t]) * clean
            + (1 - before) * math.sqrt(1 - betas[t]) / (1 - signal[t]) * x
            + (math.sqrt(betas[t] * (1 - before) / (1 - signal[t])) * noise if t else 0.0)
        )
    return x


# TalkingStyle.


def talkingstyle_state(dataset: str, seed: int = 0, dim: int = 16, layers: int = 3) -> State:
    draw, period = Drawn(seed), RATES[dataset]
    made = backbone_state("audio_encoder.", draw, large=True)
    made |= linear_state("audio_feature_map", dim, HIDDEN, draw)
    made |= linear_state("vertice_encoder", dim, COORDINATES, draw)
    made |= linear_state("vertice_decoder", COORDINATES, dim, draw)
    made["PPE.pe"] = positions(period * (600 // period + 1), dim, period)[None]
    made |= decoder_state("transformer_decoder.", dim, layers, draw)
    style = "style_encoder"
    made |= linear_state(f"{style}.obj_vector", dim, len(IDENTITIES), draw, bias=False)
    made[f"{style}.my_obj_vector.weight"] = draw(len(IDENTITIES), dim, spread=1.0)
    attention = f"{style}.attention"
    made |= {f"{attention}.attention.in_proj_weight": draw(12, 4), f"{attention}.attention.in_proj_bias": draw(12)}
    made |= linear_state(f"{attention}.attention.out_proj", 4, 4, draw)
    for name in ("Wq", "Wk", "Wv"):
        made |= linear_state(f"{attention}.{name}", 4, 1, draw)
    return made | norm_state(f"{attention}.norm", 4, draw) | linear_state(f"{attention}.head", 1, 4, draw)


def talkingstyle_style(s: State, identity: int) -> Tensor:
    """(dim,): each component attends to itself alone."""
    name = "style_encoder.attention"
    row = s["style_encoder.my_obj_vector.weight"][identity]
    query, key, value = (
        F.linear(
            linear(row[:, None], s, f"{name}.W{part}"),
            s[f"{name}.attention.in_proj_weight"][4 * third : 4 * third + 4],
            s[f"{name}.attention.in_proj_bias"][4 * third : 4 * third + 4],
        )
        for third, part in enumerate("qkv")
    )
    own = torch.full((len(row), len(row)), -torch.inf).fill_diagonal_(0.0)
    mixed = attend(query, key, value, 1, own)
    mixed = layer_norm(linear(mixed, s, f"{name}.attention.out_proj"), s, f"{name}.norm")
    return torch.relu(s["style_encoder.obj_vector.weight"][:, identity] + linear(mixed, s, f"{name}.head")[:, 0])


def talkingstyle_offsets(s: State, speech: Tensor, dataset: str, identity: int, frames: int | None = None) -> Tensor:
    """Offsets (frames, 3V)."""
    style = talkingstyle_style(s, identity)
    return autoregressive(s, speech, style, ("vertice_decoder", "vertice_encoder"), dataset, frames, 1e-7)


# SelfTalk.

LIPS = [7, 2, 2, 11, 5]
LETTERS = 33


def unmasked_layer_state(name: str, dim: int, hidden: int, draw: Drawn, *, cross: bool) -> State:
    made: State = {}
    for part in ("self_attn", "multihead_attn")[: 2 if cross else 1]:
        made |= {f"{name}.{part}.in_proj_weight": draw(3 * dim, dim)}
        made |= {f"{name}.{part}.in_proj_bias": draw(3 * dim, spread=0.1)}
        made |= linear_state(f"{name}.{part}.out_proj", dim, dim, draw)
    made |= linear_state(f"{name}.linear1", hidden, dim, draw) | linear_state(f"{name}.linear2", dim, hidden, draw)
    for norm in ("norm1", "norm2", "norm3")[: 3 if cross else 2]:
        made |= norm_state(f"{name}.{norm}", dim, draw)
    return made


def selftalk_state(dataset: str, seed: int = 0, dim: int = 16, reader_layers: int = 2) -> State:
    draw = Drawn(seed)
    made = backbone_state("audio_encoder.", draw, large=True)
    made |= backbone_state("text_encoder.wav2vec2.", draw, large=True)
    made |= linear_state("text_encoder.lm_head", LETTERS, HIDDEN, draw)
    made |= linear_state("lip_map", HIDDEN, 3 * len(LIPS), draw)
    made |= unmasked_layer_state("transformer_decoder.layers.0", dim, 2 * dim, draw, cross=True)
    made |= linear_state("audio_feature_map", dim, HIDDEN * (2 if dataset == "biwi" else 1), draw)
    for half in ("encoder", "decoder"):
        for j in range(reader_layers):
            made |= unmasked_layer_state(f"transformer.{half}.layers.{j}", HIDDEN, 24, draw, cross=half == "decoder")
        made |= norm_state(f"transformer.{half}.norm", HIDDEN, draw)
    made |= linear_state("vertice_map_r", COORDINATES, dim, draw)
    return made | linear_state("lm_head", LETTERS, HIDDEN, draw)


def unmasked_layer(
    x: Tensor, memory: Tensor | None, s: State, name: str, heads: int, mask: Tensor | float = 0.0, gelu: bool = False
) -> Tensor:
    """torch's post-norm layer; with a memory, of the decoder's form, ``mask`` added to its scores."""

    def mixed(x: Tensor, context: Tensor, part: str, bias: Tensor | float) -> Tensor:
        weights, biases = s[f"{name}.{part}.in_proj_weight"].chunk(3), s[f"{name}.{part}.in_proj_bias"].chunk(3)
        q, k, v = (F.linear(y, w, b) for y, w, b in zip((x, context, context), weights, biases, strict=True))
        return linear(attend(q, k, v, heads, bias), s, f"{name}.{part}.out_proj")

    x = layer_norm(x + mixed(x, x, "self_attn", 0.0), s, f"{name}.norm1")
    if memory is not None:
        x = layer_norm(x + mixed(x, memory, "multihead_attn", mask), s, f"{name}.norm2")
    fed = linear((F.gelu if gelu else torch.relu)(linear(x, s, f"{name}.linear1")), s, f"{name}.linear2")
    return layer_norm(x + fed, s, f"{name}.norm{2 if memory is None else 3}")


def selftalk_offsets(s: State, speech: Tensor, dataset: str, frames: int | None = None) -> Tensor:
    """Offsets (frames, 3V)."""
    features = features_of(standardised(speech, 1e-7), s, "audio_encoder.")
    if dataset == "biwi":
        hidden = hidden_of(features, s, "audio_encoder.")
        count = len(hidden) // 2 if frames is None else frames
        speech = hidden[: 2 * count].reshape(count, -1)
    else:
        features, count = resampled(features, dataset, frames)
        speech = hidden_of(features, s, "audio_encoder.")
    x = linear(speech, s, "audio_feature_map")
    return linear(unmasked_layer(x, x, s, "transformer_decoder.layers.0", 4), s, "vertice_map_r")


def selftalk_reading(s: State, offsets: Tensor, steps: int, heads: int = 8) -> tuple[Tensor, Tensor]:
    """The lip reader's features and letters, both (steps, …), of offsets (frames, 3V)."""
    columns = [3 * vertex + axis for vertex in LIPS for axis in range(3)]
    given = interpolated(linear(offsets[:, columns], s, "lip_map"), steps)
    layers = len({name.split(".")[3] for name in s if name.startswith("transformer.encoder.layers.")})
    memory = x = given
    for j in range(layers):
        memory = unmasked_layer(memory, None, s, f"transformer.encoder.layers.{j}", heads)
    memory = layer_norm(memory, s, "transformer.encoder.norm")
    for j in range(layers):
        x = unmasked_layer(x, memory, s, f"transformer.decoder.layers.{j}", heads)
    x = layer_norm(x, s, "transformer.decoder.norm")
    return x, linear(x, s, "lm_head")


def selftalk_text(s: State, speech: Tensor) -> tuple[Tensor, list[int]]:
    """The recogniser's hidden states and its greedy transcript, of which letter 0 is the blank."""
    prefix = "text_encoder.wav2vec2."
    hidden = hidden_of(features_of(standardised(speech, 1e-7), s, prefix), s, prefix)
    letters = linear(hidden, s, "text_encoder.lm_head").argmax(1).tolist()
    kept = [letter for i, letter in enumerate(letters) if i == 0 or letter != letters[i - 1]]
    return hidden, [letter for letter in kept if letter]


def ctc_of(logits: np.ndarray, transcript: list[int]) -> float:
    """−log p(transcript), the sum over all alignments by the forward recursion (Graves et al. 2006, section 4.1)."""
    exponential = np.exp(logits - logits.max(1, keepdims=True))
    p = exponential / exponential.sum(1, keepdims=True)
    states = [0] + [part for letter in transcript for part in (letter, 0)]
    alpha = np.zeros(len(states))
    alpha[:2] = p[0, states[:2]]
    for row in p[1:]:
        before = alpha
        alpha = before.copy()
        alpha[1:] += before[:-1]
        for i in range(2, len(states)):
            if states[i] and states[i] != states[i - 2]:
                alpha[i] += before[i - 2]
        alpha *= row[states]
    return -math.log(alpha[-2:].sum())


def write_author_files(folder: Path, change: Callable[[State], object] = lambda state: None) -> Path:
    """A FaceFormer checkpoint as its authors write one, with neutral faces and the audio encoder's configuration."""
    state = faceformer_state("vocaset")
    change(state)
    torch.save(state, folder / "author.pth")
    faces = {name: np.full((VERTICES, 3), float(i)) for i, name in enumerate(IDENTITIES)}
    (folder / "faces.pkl").write_bytes(pickle.dumps(faces))
    (folder / "audio.json").write_text(json.dumps(AUDIO_CONFIG), encoding="utf-8")
    return folder / "author.pth"
