"""The dual-path network against forwards written from the equations of the paper in NumPy (float64)."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
import pytest
import scipy.special
import torch
from scipy.special import erf, expit
from torch import nn

from facediff import registry
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.network import DualPathNetwork, StepEmbedding
from facediff.models.dual_path.options import DualPathOptions

Array = np.ndarray
DIM, HEADS = 16, 4
LENGTHS = (7, 12, 1)


def weights(module: nn.Module) -> dict[str, Array]:
    return {name: value.detach().numpy() for name, value in module.state_dict().items()}


def under(found: dict[str, Array], prefix: str) -> dict[str, Array]:
    return {name[len(prefix) + 1 :]: value for name, value in found.items() if name.startswith(f"{prefix}.")}


def linear(x: Array, w: dict[str, Array]) -> Array:
    return x @ w["weight"].T + w.get("bias", 0.0)


def norm(x: Array, w: dict[str, Array]) -> Array:
    centred = x - x.mean(-1, keepdims=True)
    return centred / np.sqrt((centred**2).mean(-1, keepdims=True) + 1e-5) * w["weight"] + w["bias"]


def gelu(x: Array) -> Array:
    return 0.5 * x * (1 + erf(x / math.sqrt(2)))


softmax = partial(scipy.special.softmax, axis=-1)


def rotate(x: Array) -> Array:
    """RoFormer, eq. 34: channel pair (i, i + d/2) of frame t is turned by t · 10000^(−2i/d)."""
    frames, d = x.shape
    out = np.empty_like(x)
    for t in range(frames):
        for i in range(d // 2):
            angle = t * 10_000.0 ** (-2 * i / d)
            a, b = x[t, i], x[t, i + d // 2]
            out[t, i] = a * math.cos(angle) - b * math.sin(angle)
            out[t, i + d // 2] = a * math.sin(angle) + b * math.cos(angle)
    return out


def attention(x: Array, context: Array, w: dict[str, Array], *, rotary: bool) -> Array:
    query, both = linear(x, under(w, "query")), linear(context, under(w, "key_value"))
    key, value = both[:, :DIM], both[:, DIM:]
    size = DIM // HEADS
    mixed = []
    for head in range(HEADS):
        part = slice(head * size, (head + 1) * size)
        q, k = query[:, part], key[:, part]
        if rotary:
            q, k = rotate(q), rotate(k)
        mixed.append(softmax(q @ k.T / math.sqrt(size)) @ value[:, part])
    return linear(np.concatenate(mixed, -1), under(w, "out"))


def feed_forward(x: Array, w: dict[str, Array]) -> Array:
    return linear(gelu(linear(x, under(w, "0"))), under(w, "3"))


def convolution(x: Array, w: dict[str, Array], dilation: int) -> Array:
    """Causal, with weight norm: w = g v / ‖v‖."""
    g, v = w["parametrizations.weight.original0"], w["parametrizations.weight.original1"]
    kernel = g * v / np.sqrt((v**2).sum((1, 2), keepdims=True))
    out = np.zeros((len(x), kernel.shape[0])) + w["bias"]
    taps = kernel.shape[2]
    for t in range(len(x)):
        for tap in range(taps):
            source = t - dilation * (taps - 1 - tap)
            if source >= 0:
                out[t] += kernel[:, :, tap] @ x[source]
    return out


def gru(x: Array, w: dict[str, Array], suffix: str) -> Array:
    hidden, states = np.zeros(DIM // 2), []
    for frame in x:
        i = w[f"weight_ih_l0{suffix}"] @ frame + w[f"bias_ih_l0{suffix}"]
        h = w[f"weight_hh_l0{suffix}"] @ hidden + w[f"bias_hh_l0{suffix}"]
        (ir, iz, inn), (hr, hz, hn) = np.split(i, 3), np.split(h, 3)
        reset, update = expit(ir + hr), expit(iz + hz)
        hidden = (1 - update) * np.tanh(inn + reset * hn) + update * hidden
        states.append(hidden)
    return np.array(states)


def style(x: Array, w: dict[str, Array], dilations: tuple[int, ...] = (1, 2, 4, 8, 16)) -> Array:
    branches = []
    for i, dilation in enumerate(dilations):
        block = under(w, f"branches.{i}")
        hidden = np.maximum(convolution(x, under(block, "first"), dilation), 0)
        hidden = np.maximum(convolution(hidden, under(block, "second"), dilation), 0)
        branches.append(np.maximum(x + hidden, 0))
    tcn = np.mean(branches, 0)  # eq. 2
    recurrent = under(w, "gru")
    h = np.concatenate([gru(tcn, recurrent, ""), gru(tcn[::-1], recurrent, "_reverse")[::-1]], -1)  # eq. 3 to 5
    table, frames = w["positions"], len(x)
    place = np.clip((np.arange(frames) + 0.5) * len(table) / frames - 0.5, 0, len(table) - 1)
    low = np.floor(place).astype(int)
    share = (place - low)[:, None]
    h = h + table[low] * (1 - share) + table[np.minimum(low + 1, len(table) - 1)] * share
    for i in range(2):  # eq. 6
        layer = under(w, f"layers.{i}")
        normed = norm(h, under(layer, "attention_norm"))
        h = h + attention(normed, normed, under(layer, "attention"), rotary=False)
        h = h + feed_forward(norm(h, under(layer, "feed_forward_norm")), under(layer, "feed_forward"))
    h = norm(h, under(w, "norm"))
    pooling = under(w, "pooling")
    score = np.tanh(linear(h, under(pooling, "hidden"))) @ pooling["score.weight"][0]  # eq. 7
    s = softmax(score) @ h  # eq. 8
    return linear(gelu(linear(s, under(w, "mlp.0"))), under(w, "mlp.2"))  # eq. 9


def fused(audio: Array, motion: Array, w: dict[str, Array]) -> Array:
    normed = norm(motion, under(w, "motion_norm"))
    speech = norm(audio, under(w, "audio_norm"))
    audio = audio + attention(speech, normed, under(w, "audio_from_motion"), rotary=True)
    enriched = norm(audio, under(w, "enriched_norm"))
    motion = motion + attention(normed, enriched, under(w, "motion_from_audio"), rotary=True)
    return audio + motion  # eq. 12


def decoded(x: Array, tokens: Array, w: dict[str, Array], layers: int) -> Array:
    for i in range(layers):
        block = under(w, f"blocks.{i}")
        normed = norm(x, under(block, "time_norm"))
        x = x + attention(normed, normed, under(block, "time_attention"), rotary=True)
        x = x + attention(norm(x, under(block, "style_norm")), tokens, under(block, "style_attention"), rotary=False)
        x = x + feed_forward(norm(x, under(block, "feed_forward_norm")), under(block, "feed_forward"))
    return norm(x, under(w, "norm"))


def step_embedding(n: int, w: dict[str, Array]) -> Array:
    half = DIM // 2
    angle = n * np.exp(-math.log(10_000.0) * np.arange(half) / half)
    x = linear(np.concatenate([np.sin(angle), np.cos(angle)]), under(w, "mlp.0"))
    return linear(x * expit(x), under(w, "mlp.2"))


@pytest.fixture(autouse=True)
def _double() -> Any:  # noqa: ANN401
    torch.manual_seed(3)
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def batch(width: int = DIM, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    x = torch.randn(len(LENGTHS), max(LENGTHS) + 3, width, generator=generator)
    mask = torch.arange(x.shape[1])[None] < torch.tensor(LENGTHS)[:, None]
    return x, mask


def shaken(module: nn.Module) -> nn.Module:
    """Every parameter random, norms and biases too: at their start they would hide a missing term."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.3 * torch.randn_like(parameter))
    return module.double().eval()


def compare(made: torch.Tensor, expected: list[Array]) -> None:
    for row, length, value in zip(made.detach().numpy(), LENGTHS, expected, strict=True):
        np.testing.assert_allclose(row[:length] if value.ndim == 2 else row, value, rtol=2e-6, atol=2e-6)


def test_the_style_encoder_is_eq_2_to_9() -> None:
    module = shaken(registry.style_encoder.tcn_gru_transformer(dim=DIM, n_positions=9))
    x, mask = batch()
    compare(module(x, mask), [style(row[:n].numpy(), weights(module)) for row, n in zip(x, LENGTHS, strict=True)])


def test_the_fusion_is_eq_12() -> None:
    module = shaken(registry.fusion.cross_attention(dim=DIM))
    (audio, mask), (motion, _) = batch(), batch(seed=1)
    rows = zip(audio, motion, LENGTHS, strict=True)
    expected = [fused(a[:n].numpy(), m[:n].numpy(), weights(module)) for a, m, n in rows]
    compare(module(audio, motion, mask), expected)
    compare(module(audio, motion, mask, module.prepare(audio, mask)), expected)


def test_the_decoder_is_figure_3() -> None:
    module = shaken(registry.decoder.style_transformer(dim=DIM, style_dim=6, num_layers=2))
    x, mask = batch()
    tokens = torch.randn(len(LENGTHS), 3, 6)
    rows = zip(x, tokens, LENGTHS, strict=True)
    expected = [decoded(r[:n].numpy(), t.numpy(), weights(module), 2) for r, t, n in rows]
    compare(module(x, tokens, mask), expected)
    compare(module(x, tokens, mask, module.prepare(tokens, mask)), expected)


def test_the_step_embedding_is_sinusoids_and_an_mlp() -> None:
    module = shaken(StepEmbedding(DIM))
    steps = torch.tensor([0, 1, 500, 999])
    expected = np.array([step_embedding(int(n), weights(module)) for n in steps])
    np.testing.assert_allclose(module(steps).detach().numpy(), expected, rtol=1e-5, atol=1e-5)


def test_the_core_adds_the_step_before_the_norm() -> None:
    """Eq. 13, with all parts: from speech features, noisy motion, step and style to F_dec."""
    decoder = partial(registry.decoder.style_transformer, num_layers=1)
    options, sizes = DualPathOptions(dim=DIM, decoder=decoder), {"n_vertices": 5, "dims": 3}
    space = registry.motion_space.vertices(**sizes, steps=1000)
    network = DualPathNetwork(options, space, **sizes, identities=2)
    w = weights(shaken(network))
    (audio, mask), (motion, _) = batch(), batch(seed=1)
    tokens = torch.randn(len(LENGTHS), 4, DIM)
    step = torch.tensor([0, 17, 999])
    made = network.core(motion, step, Conditions(audio, tokens, mask))
    expected = []
    for i, n in enumerate(LENGTHS):
        f = fused(audio[i, :n].numpy(), motion[i, :n].numpy(), under(w, "fusion"))
        f = norm(f + step_embedding(int(step[i]), under(w, "step_embedding")), under(w, "fused_norm"))
        expected.append(decoded(f, tokens[i].numpy(), under(w, "decoder"), 1))
    for row, length, value in zip(made.detach().numpy(), LENGTHS, expected, strict=True):
        np.testing.assert_allclose(row[:length], value, rtol=1e-4, atol=1e-4)  # the step's angles are float32


def gru_layer(x: Array, w: dict[str, Array], layer: int, suffix: str) -> Array:
    part = {name.replace(f"_l{layer}", "_l0"): value for name, value in w.items() if f"_l{layer}" in name}
    return gru(x, part, suffix)


def test_the_recurrent_decoder_is_a_modulated_norm() -> None:
    """Two bidirectional layers; then the norm of states plus input, scaled and shifted by the mean style token."""
    module = shaken(registry.decoder.gru(dim=DIM, style_dim=6, num_layers=2))
    w = weights(module)
    x, mask = batch()
    tokens = torch.randn(len(LENGTHS), 3, 6)
    expected = []
    for row, n, token in zip(x, LENGTHS, tokens, strict=True):
        hidden = row[:n].numpy()
        for layer in range(2):
            forward = gru_layer(hidden, under(w, "gru"), layer, "")
            backward = gru_layer(hidden[::-1], under(w, "gru"), layer, "_reverse")[::-1]
            hidden = np.concatenate([forward, backward], -1)
        scale, shift = np.split(linear(token.numpy().mean(0), under(w, "modulation")), 2)
        expected.append(norm(hidden + row[:n].numpy(), under(w, "norm")) * (1 + scale) + shift)
    compare(module(x, tokens, mask), expected)
    compare(module(x, tokens, mask, module.prepare(tokens, mask)), expected)


def mel(audio: Array, frames: int, module: nn.Module, w: dict[str, Array]) -> Array:
    """One clip: spectra of 25 ms every 10 ms, convolutions at 50 steps a second, interpolation to the frames."""
    wave = (audio - audio.mean()) / np.sqrt(audio.var() + 1e-7)
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(400) / 400)
    count = max(2, len(wave) // 160)
    spectra = np.zeros((count, 64))
    for i in range(count):
        places = 160 * i - 200 + np.arange(400)
        inside = (places >= 0) & (places < len(wave))
        piece = np.where(inside, wave[np.clip(places, 0, len(wave) - 1)], 0.0) * window
        power = np.abs(np.fft.rfft(piece, 512)) ** 2
        spectra[i] = np.log(module.filters.numpy().astype("f8") @ power + 1e-5)
    x = (spectra + 2.0) / 4.0

    def convolved(x: Array, part: dict[str, Array], *, stride: int, pad: int, dilation: int) -> Array:
        padded = np.pad(x, ((pad, pad), (0, 0)))
        taps = part["weight"].shape[2]
        steps = (len(padded) - dilation * (taps - 1) - 1) // stride + 1
        out = np.tile(part["bias"], (steps, 1))
        for t in range(steps):
            for tap in range(taps):
                out[t] += part["weight"][:, :, tap] @ padded[t * stride + tap * dilation]
        return out

    steps = max(1, count // 2)
    x = gelu(convolved(x, under(w, "stem"), stride=2, pad=1, dilation=1))[:steps]
    for i, dilation in enumerate((1, 2, 4, 1)):
        block = under(w, f"blocks.{i}")
        hidden = convolved(
            norm(x, under(block, "norm")), under(block, "conv"), stride=1, pad=2 * dilation, dilation=dilation
        )
        x = x + linear(gelu(hidden), under(block, "mix"))
    x = linear(norm(x, under(w, "out.0")), under(w, "out.1"))
    wanted, centres = (np.arange(frames) + 0.5) / frames, (np.arange(steps) + 0.5) / steps
    return np.stack([np.interp(wanted, centres, channel) for channel in x.T], -1)


def test_the_mel_encoder_is_log_mel_spectra_and_convolutions() -> None:
    torch.set_default_dtype(torch.float32)  # the Fourier transform is taken in float32
    module = registry.audio_encoder.mel(dim=DIM, hidden_dim=12, num_layers=4).eval()
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    samples, frames = (9600, 4815, 700), (15, 11, 2)
    waves = torch.zeros(3, 9600)
    for row, n in zip(waves, samples, strict=True):
        row[:n] = 0.3 + 0.2 * torch.randn(n)
    made = module(waves, torch.tensor(samples), torch.tensor(frames)).detach().numpy()
    w = {name: value.astype("f8") for name, value in weights(module).items()}
    for row, wave, n, count in zip(made, waves, samples, frames, strict=True):
        expected = mel(wave[:n].double().numpy(), count, module, w)
        np.testing.assert_allclose(row[:count], expected, rtol=2e-3, atol=2e-3)
        assert not row[count:].any()
    # The level of a whole recording instead of a clip's own.
    with module.at_level(0.1, 0.5):
        levelled = module(waves, torch.tensor(samples), torch.tensor(frames)).detach().numpy()
    whole = module.standardise
    module.standardise = lambda audio, lengths: (audio - 0.1) / 0.5 * (torch.arange(9600) < lengths[:, None])
    again = module(waves, torch.tensor(samples), torch.tensor(frames)).detach().numpy()
    np.testing.assert_allclose(levelled, again, rtol=1e-4, atol=1e-4)
    module.standardise = whole
