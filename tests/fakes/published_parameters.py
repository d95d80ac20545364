"""Tiny checkpoints of DiffPoseTalk and ARTalk by their authors' names, and what their formulas make of them.

As in tests/fakes/published.py, the references work on the authors' tensors, one clip at a time and window by window.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PosixPath
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from tests.fakes.published import (
    HIDDEN,
    Drawn,
    State,
    attend,
    backbone_state,
    features_of,
    hidden_of,
    layer_norm,
    linear,
    linear_state,
    unmasked_layer,
    unmasked_layer_state,
)

WINDOW, CONTEXT, STEPS, SHAPE, STYLE, DIM = 20, 4, 5, 100, 16, 16
SCALES, CODE, CODEC, CHANNELS = (1, 2, 5, 10), 8, 16, 106


gelu_layer = partial(unmasked_layer, gelu=True)


def waves(rows: int, dim: int) -> Tensor:
    """sin and cos in turn, each row by itself."""
    table = np.zeros((rows, dim), np.float64)
    for n in range(rows):
        for k in range(dim // 2):
            angle = n / 10_000 ** (2 * k / dim)
            table[n, 2 * k], table[n, 2 * k + 1] = math.sin(angle), math.cos(angle)
    return torch.from_numpy(table).float()


def style_state(prefix: str, channels: int, dim: int, draw: Drawn, layers: int = 2) -> State:
    made = linear_state(f"{prefix}encoder.motion_proj", dim, channels, draw)
    for j in range(layers):
        made |= unmasked_layer_state(f"{prefix}encoder.transformer.layers.{j}", dim, 4 * dim, draw, cross=False)
    return made | {f"{prefix}PE.pe": waves(60, dim)[None]}


def style_reference(s: State, motion: Tensor, prefix: str, heads: int = 4, layers: int = 2) -> Tensor:
    """The style (dim,) of standardised motion, with the one row of the table that the authors add."""
    x = linear(motion, s, f"{prefix}encoder.motion_proj") + s[f"{prefix}PE.pe"][0, len(motion)]
    for j in range(layers):
        x = gelu_layer(x, None, s, f"{prefix}encoder.transformer.layers.{j}", heads)
    return x.mean(0)


# DiffPoseTalk.


def diffposetalk_states(head: bool, seed: int = 0) -> tuple[State, State]:
    """The denoiser's tensors and the style encoder's."""
    draw, channels = Drawn(seed), 54 if head else 51
    made = backbone_state("audio_encoder.", draw) | linear_state("audio_feature_map", DIM, HIDDEN, draw)
    for name, shape in (
        ("start_audio_feat", (1, CONTEXT, DIM)),
        ("start_motion_feat", (1, CONTEXT, channels)),
        ("null_audio_feat", (1, 1, DIM)),
        ("null_style_feat", (1, 1, STYLE)),
        ("denoising_net.PE", (1, 1 + CONTEXT + WINDOW, DIM)),
    ):
        made[name] = draw(*shape, spread=0.5)
    made["denoising_net.TE.pe"] = torch.zeros(1, STEPS + 1, DIM)  # the authors drop it
    for i in (0, 2):
        made |= linear_state(f"denoising_net.diff_step_map.{i}", DIM, DIM, draw)
    made |= linear_state("denoising_net.person_proj", DIM, SHAPE + STYLE, draw)
    made |= linear_state("denoising_net.feature_proj", DIM, channels + 1, draw)
    for j in range(2):
        made |= unmasked_layer_state(f"denoising_net.transformer.layers.{j}", DIM, 4 * DIM, draw, cross=True)
    frames = CONTEXT + WINDOW
    mask = torch.ones(1 + frames, frames, dtype=torch.bool)
    mask[0], mask[1:] = False, ~torch.eye(frames, dtype=torch.bool)
    made["denoising_net.alignment_mask"] = mask
    made |= linear_state("denoising_net.motion_dec.0", DIM // 2, DIM, draw)
    made |= linear_state("denoising_net.motion_dec.2", channels, DIM // 2, draw)
    made |= {f"diffusion_sched.{name}": torch.from_numpy(value).float() for name, value in schedule(STEPS).items()}
    return made, style_state("", channels, STYLE, draw)


def schedule(steps: int) -> dict[str, np.ndarray]:
    """The cosine schedule in double precision."""

    def left(n: int) -> float:
        return math.cos((n / steps + 0.008) / 1.008 * math.pi / 2) ** 2

    betas = np.array([0.0, *(min(max(1 - left(n + 1) / left(n), 1e-4), 0.999) for n in range(steps))])
    bars = np.cumprod(1 - betas)
    small = np.array([0.0, *((1 - bars[n - 1]) / (1 - bars[n]) * betas[n] for n in range(1, steps + 1))])
    return {
        "betas": betas,
        "alphas": 1 - betas,
        "alpha_bars": bars,
        "sigmas_flex": np.sqrt(betas),
        "sigmas_inflex": np.sqrt(small),
    }


def statistics(seed: int = 5) -> dict[str, np.ndarray]:
    draw = Drawn(seed)
    sizes = {"exp": 50, "pose": 6, "shape": SHAPE}
    means = {f"{key}_mean": draw(size, spread=0.1).numpy() for key, size in sizes.items()}
    return means | {f"{key}_std": draw(size, spread=0.1, shift=1.0).abs().numpy() for key, size in sizes.items()}


def write_diffposetalk(folder: Path, *, head: bool, **changes: Any) -> list[Path]:  # noqa: ANN401
    """The two files, with the options of a released one and changes of them."""
    model, style = diffposetalk_states(head)
    common = {"rot_repr": "aa", "n_motions": WINDOW, "fps": 25, "data_root": PosixPath("datasets/HDTF_TFHP/lmdb")}
    common |= changes
    options: dict[str, Any] = {
        **common,
        **{"target": "sample", "architecture": "decoder", "audio_model": "hubert", "n_heads": 2, "pad_mode": "zero"},
        **{"cfg_mode": "incremental", "guiding_conditions": "audio,style", "use_indicator": True},
        **{"predict_head_pose": head, "use_alignment_mask": True, "use_learnable_pe": True},
    }
    files = [folder / "iter_0110000.pt", folder / "iter_0026000.pt"]
    torch.save({"args": argparse.Namespace(**options), "model": model}, files[0])
    torch.save({"args": argparse.Namespace(**common, n_heads=4), "encoder": style, "iter": 26000}, files[1])
    return files


def denoised(
    s: State, noisy: Tensor, audio: Tensor, person: Tensor, before: tuple[Tensor, Tensor], step: int, real: Tensor
) -> Tensor:
    """The denoiser's prediction for context and window."""
    te = waves(STEPS + 1, DIM)[step]
    te = linear(F.gelu(linear(te, s, "denoising_net.diff_step_map.0")), s, "denoising_net.diff_step_map.2")
    token = linear(person, s, "denoising_net.person_proj") + te
    marks = torch.cat([torch.zeros(CONTEXT), real])[:, None]
    frames = torch.cat([torch.cat([before[0], noisy]), marks], 1)
    x = torch.cat([token[None], linear(frames, s, "denoising_net.feature_proj")]) + s["denoising_net.PE"][0]
    memory = torch.cat([before[1], audio])
    mask = torch.full((1 + CONTEXT + WINDOW, CONTEXT + WINDOW), -torch.inf)
    mask[0] = 0.0
    for i in range(CONTEXT + WINDOW):
        mask[1 + i, i] = 0.0
    for j in range(2):
        x = gelu_layer(x, memory, s, f"denoising_net.transformer.layers.{j}", 2, mask)
    return linear(F.gelu(linear(x[1:], s, "denoising_net.motion_dec.0")), s, "denoising_net.motion_dec.2")


def halved(x: Tensor) -> Tensor:
    """Linear interpolation to half as many steps, each in the middle of its stretch: means of pairs."""
    return (x[0::2] + x[1::2]) / 2


def diffposetalk_speech(s: State, wave: Tensor) -> Tensor:
    """Speech of a wave of whole frames: 20 samples mirrored at either end, twice."""
    for _ in range(2):
        wave = torch.cat([wave[1:21].flip(0), wave, wave[-21:-1].flip(0)])
    return linear(
        halved(hidden_of(features_of(wave, s, "audio_encoder."), s, "audio_encoder.")), s, "audio_feature_map"
    )


def diffposetalk_reference(
    s: State,
    audio: Tensor,
    shape: Tensor,
    style: Tensor | None,
    draw: Callable[[Tensor], Tensor],
    *,
    conditions: Sequence[str] = ("audio", "style"),
    scales: Sequence[float] = (1.15, 3.0),
    independent: bool = False,
    context: bool = True,
    threshold: tuple[float, float, float] | None = None,
) -> Tensor:
    """Standardised motion, guided step by step as the authors' sampler has it."""
    audio = (audio - audio.mean()) / (audio.std() + 1e-5)
    frames, unit = int(len(audio) / 16_000 * 25), 640
    windows = max(1, -(-frames // WINDOW))
    filled = windows * WINDOW * unit - len(audio)
    audio = torch.cat([audio, torch.zeros(max(0, filled))])
    filled_frames = -(-filled // unit)
    heard = diffposetalk_speech(s, audio) if context else torch.zeros(0)
    no_style, no_audio = s["null_style_feat"][0, 0], s["null_audio_feat"][0].expand(WINDOW, -1)
    style = no_style if style is None else style
    start = draw(torch.zeros(1, WINDOW, s["start_motion_feat"].shape[2]))[0]
    before, parts, rates = (s["start_motion_feat"][0], s["start_audio_feat"][0]), [], schedule(STEPS)
    for number in range(windows):
        first = number * WINDOW
        speech = heard[first : first + WINDOW]
        if not context:
            speech = diffposetalk_speech(s, audio[first * unit : (first + WINDOW) * unit])
        real = torch.ones(WINDOW)
        if number == windows - 1 and filled_frames > 0:
            real[-filled_frames:] = 0
        x = start
        for t in range(STEPS, 0, -1):
            z = draw(x[None])[0] if t > 1 else torch.zeros_like(x)

            def predicted(
                a: bool,
                b: bool,
                state: tuple[Tensor, Tensor, int, Tensor, tuple[Tensor, Tensor]] = (x, speech, t, real, before),
            ) -> Tensor:
                x, speech, t, real, before = state
                person = torch.cat([shape, style if b or "style" not in conditions else no_style])
                chosen = speech if a or "audio" not in conditions else no_audio
                whole = denoised(s, x, chosen, person, before, t, real)
                if threshold is not None:
                    bound = torch.quantile(whole[CONTEXT:].abs().flatten(), threshold[0]).clamp(*threshold[1:])
                    whole = whole.clamp(-bound, bound)
                return whole[CONTEXT:]

            clean = predicted(False, False)
            if conditions == ("audio",):
                clean = clean + scales[0] * (predicted(True, False) - clean)
            elif conditions and not independent:
                a = predicted(True, False)
                clean = clean + scales[0] * (a - clean) + scales[1] * (predicted(True, True) - a)
            elif conditions:
                clean = clean + scales[0] * (predicted(True, False) - clean)
                clean = clean + scales[1] * (predicted(False, True) - clean)
            bar, last, alpha = rates["alpha_bars"][t], rates["alpha_bars"][t - 1], rates["alphas"][t]
            of_noisy, of_clean = (1 - last) * math.sqrt(alpha) / (1 - bar), (1 - alpha) * math.sqrt(last) / (1 - bar)
            x = of_noisy * x + of_clean * clean + float(rates["sigmas_inflex"][t]) * z
        before = (x[-CONTEXT:], speech[-CONTEXT:])
        parts.append(x)
    motion = torch.cat(parts)
    return motion[:-filled_frames] if filled_frames > 0 else motion


# ARTalk.


def artalk_state(seed: int = 0) -> State:
    draw, total = Drawn(seed), sum(SCALES)
    made = backbone_state("audio_encoder.", draw, large=True)
    for half, into, out in (("encoder", CHANNELS, CODE), ("decoder", CODE, CHANNELS)):
        name = f"basic_vae.{half}"
        made |= linear_state(f"{name}.inp_mapping.0", CODEC, into, draw)
        for j in range(2):
            layer = f"{name}.{half}_transformer"
            made |= {
                f"{layer}.{2 * j}.norm.weight": draw(CODEC, spread=0.1, shift=1.0),
                f"{layer}.{2 * j}.norm.bias": draw(CODEC, spread=0.1),
                **linear_state(f"{layer}.{2 * j}.to_qkv", 3 * CODEC, CODEC, draw, bias=False),
                **linear_state(f"{layer}.{2 * j}.to_out", CODEC, CODEC, draw),
                **linear_state(f"{layer}.{2 * j + 1}.0", 24, CODEC, draw),
                **linear_state(f"{layer}.{2 * j + 1}.2", CODEC, 24, draw),
            }
        made |= linear_state(f"{name}.{'code' if half == 'encoder' else 'out'}_mapping", out, CODEC, draw)
    made["basic_vae.enc_pos_embed"] = draw(1, 2 * SCALES[-1], CHANNELS, spread=0.3)
    made["basic_vae.dec_pos_embed"] = draw(1, 2 * SCALES[-1], CODE, spread=0.3)
    made["basic_vae.attn_mask"] = torch.zeros(1, 1, 2 * SCALES[-1], 2 * SCALES[-1])
    for owner in ("basic_vae", "style_encoder"):
        made[f"{owner}.motion_mean"] = draw(CHANNELS, spread=0.1)
        made[f"{owner}.motion_std"] = draw(CHANNELS, spread=0.1, shift=1.0)
    made |= style_state("style_encoder.", CHANNELS, STYLE, draw)
    made |= linear_state("vqfeat_embed", DIM, CODE, draw) | linear_state("style_cond_embed", DIM, STYLE, draw)
    for j in range(2):
        block = f"attn_blocks.{j}"
        made[f"{block}.attn.scale_mul_1H11"] = draw(1, 2, 1, 1, spread=2.0, shift=3.5)
        for part in ("query", "key", "value", "proj"):
            made |= linear_state(f"{block}.attn.{part}", DIM, DIM, draw, bias=part != "key")
        made |= linear_state(f"{block}.ffn.0", 4 * DIM, DIM, draw) | linear_state(f"{block}.ffn.2", DIM, 4 * DIM, draw)
        made |= linear_state(f"{block}.ada_lin.1", 6 * DIM, HIDDEN, draw)
    made |= linear_state("cond_logits_head.ada_lin.1", 2 * DIM, HIDDEN, draw)
    made |= linear_state("logits_head", 2 * CODE, DIM, draw)
    made["null_style_cond"] = draw(1, 1, DIM, spread=0.5)
    made["pos_embed"], made["prev_pos_embed"] = draw(1, total, DIM, spread=0.2), draw(1, total, DIM, spread=0.2)
    made["lvl_embed.weight"] = draw(len(SCALES), DIM, spread=0.2)
    made["lvl_idx"] = torch.cat([torch.full((count,), i) for i, count in enumerate(SCALES)])[None]
    made["attn_bias_for_masking"] = torch.zeros(1, 1, total, 2 * total)
    return made


def area(x: Tensor, count: int) -> Tensor:
    """Means of the stretches ⌊i·n/count⌋ … ⌈(i + 1)·n/count⌉."""
    n = len(x)
    return torch.stack([x[i * n // count : -(-(i + 1) * n // count)].mean(0) for i in range(count)])


def stretched(x: Tensor, count: int) -> Tensor:
    """Linear interpolation at (i + ½)·n/count − ½, held at the ends."""
    rows = []
    for i in range(count):
        place = min(max((i + 0.5) * len(x) / count - 0.5, 0.0), len(x) - 1)
        low = int(place)
        rows.append(x[low] + (place - low) * (x[min(low + 1, len(x) - 1)] - x[low]))
    return torch.stack(rows)


def codec_half(x: Tensor, s: State, half: str, mask: Tensor) -> Tensor:
    name = f"basic_vae.{half}"
    x = F.leaky_relu(linear(x, s, f"{name}.inp_mapping.0"), 0.2)
    for j in range(2):
        layer = f"{name}.{half}_transformer.{2 * j}"
        q, k, v = linear(layer_norm(x, s, f"{layer}.norm"), s, f"{layer}.to_qkv").chunk(3, 1)
        # attend() divides by the root of a head's width; the authors by that of all heads.
        q = q * math.sqrt((CODEC // 2) / CODEC)
        x = x + linear(attend(q, k, v, 2, mask), s, f"{layer}.to_out")
        layer = f"{name}.{half}_transformer.{2 * j + 1}"
        x = x + linear(F.gelu(linear(x, s, f"{layer}.0"), approximate="tanh"), s, f"{layer}.2")
    return linear(x, s, f"{name}.{'code' if half == 'encoder' else 'out'}_mapping")


def artalk_bits(motion: Tensor, s: State) -> list[Tensor]:
    """Bits (−1 or 1) of a chunk by itself, rate by rate."""
    frames = SCALES[-1]
    x = (motion - s["basic_vae.motion_mean"]) / s["basic_vae.motion_std"] + s["basic_vae.enc_pos_embed"][0, :frames]
    left, bits = codec_half(x, s, "encoder", torch.zeros(frames, frames)), []
    for count in SCALES:
        mean = area(left, count)
        mean = mean / mean.norm(dim=1, keepdim=True)
        bits.append(torch.where(mean > 0, 1.0, -1.0))
        left = left - stretched(bits[-1], frames) / math.sqrt(CODE)
    return bits


def artalk_sum(bits: list[Tensor]) -> Tensor:
    return sum((stretched(b, SCALES[-1]) / math.sqrt(CODE) for b in bits), start=torch.zeros(SCALES[-1], CODE))


def artalk_tokens(bits: list[Tensor], s: State, style: Tensor) -> Tensor:
    """The style, and for each next rate what the bits so far stand for."""
    inputs = [area(artalk_sum(bits[: i + 1]), SCALES[i + 1]) for i in range(min(len(bits), len(SCALES) - 1))]
    return torch.cat([style[None], *(linear(x, s, "vqfeat_embed") for x in inputs)])


def artalk_pass(tokens: Tensor, past: Tensor, audio: Tensor, s: State) -> Tensor:
    level = s["lvl_embed.weight"][s["lvl_idx"][0]]
    past, count = past + level + s["prev_pos_embed"][0], len(tokens)
    x = tokens + (level + s["pos_embed"][0])[:count]
    levels = s["lvl_idx"][0]
    mask = torch.zeros(count, len(past) + count)
    for i in range(count):
        for j in range(count):
            if levels[j] > levels[i]:
                mask[i, len(past) + j] = -torch.inf

    def plain_norm(x: Tensor) -> Tensor:
        return F.layer_norm(x, x.shape[-1:], eps=1e-6)

    for b in range(2):
        name = f"attn_blocks.{b}"
        g1, g2, s1, s2, h1, h2 = linear(F.silu(audio[:count]), s, f"{name}.ada_lin.1").chunk(6, 1)
        y = plain_norm(x) * (1 + s1) + h1
        q = linear(y, s, f"{name}.attn.query")
        k, v = (linear(torch.cat([past, y]), s, f"{name}.attn.{part}") for part in ("key", "value"))
        scale = s[f"{name}.attn.scale_mul_1H11"].clamp(max=math.log(100)).exp()[0, :, 0, 0]
        head = DIM // 2
        mixed = []
        for h in range(2):
            part = slice(h * head, (h + 1) * head)
            qh = q[:, part] / q[:, part].norm(dim=1, keepdim=True) * scale[h]
            kh = k[:, part] / k[:, part].norm(dim=1, keepdim=True)
            mixed.append((qh @ kh.T + mask).softmax(1) @ v[:, part])
        x = x + g1 * linear(torch.cat(mixed, 1), s, f"{name}.attn.proj")
        y = plain_norm(x) * (1 + s2) + h2
        x = x + g2 * linear(F.gelu(linear(y, s, f"{name}.ffn.0"), approximate="tanh"), s, f"{name}.ffn.2")
    s1, h1 = linear(F.silu(audio[:count]), s, "cond_logits_head.ada_lin.1").chunk(2, 1)
    return linear(plain_norm(x) * (1 + s1) + h1, s, "logits_head").view(count, CODE, 2)


def artalk_reference(s: State, audio: Tensor, style_motion: Tensor | None) -> tuple[Tensor, Tensor]:
    """Motion before it is smoothed, and the scores of every chunk."""
    style = s["null_style_cond"][0, 0]
    if style_motion is not None:
        normed = (style_motion - s["style_encoder.motion_mean"]) / s["style_encoder.motion_std"]
        style = 1.1 * linear(style_reference(s, normed, "style_encoder."), s, "style_cond_embed") - 0.1 * style
    frames, size = math.ceil(len(audio) / 640), SCALES[-1]
    before, parts, scores = artalk_bits(torch.zeros(size, CHANNELS), s), [], []
    mask = torch.zeros(2 * size, 2 * size)
    mask[:size, size:] = -torch.inf
    for start in range(0, frames, size):
        chunk = audio[start * 640 : (start + size) * 640]
        chunk = torch.cat([chunk, torch.zeros(size * 640 - len(chunk))])
        chunk = (chunk - chunk.mean()) / (chunk.std() + 1e-6)
        heard = hidden_of(features_of(chunk, s, "audio_encoder."), s, "audio_encoder.")
        conditions = torch.cat([area(heard, count) for count in SCALES])
        past, bits, logits = artalk_tokens(before, s, style), [], torch.zeros(0)
        for _ in SCALES:
            logits = artalk_pass(artalk_tokens(bits, s, style), past, conditions, s)
            signs = logits.argmax(2) * 2.0 - 1.0
            bits = list(signs.split(SCALES[: len(bits) + 1]))
        codes = torch.cat([artalk_sum(before), artalk_sum(bits)]) + s["basic_vae.dec_pos_embed"][0]
        motion = codec_half(codes, s, "decoder", mask)[size:]
        motion = motion * s["basic_vae.motion_std"] + s["basic_vae.motion_mean"]
        before = artalk_bits(motion, s)
        parts.append(motion)
        scores.append(logits)
    return torch.cat(parts)[:frames], torch.stack(scores)
