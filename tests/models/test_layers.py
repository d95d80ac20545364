"""The shared building blocks against NumPy and against the properties that they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from facediff.models.layers import (
    Attention,
    RotaryEmbedding,
    interpolate_frames,
    recurrent_nodes,
)
from tests.fakes.onnx_nodes import recurrent_node

Array = NDArray[np.float64]


def linear(layer: nn.Linear, x: Array) -> Array:
    return x @ layer.weight.detach().double().numpy().T + layer.bias.detach().double().numpy()


def softmax(x: Array) -> Array:
    weights = np.exp(x - x.max(-1, keepdims=True))
    return weights / weights.sum(-1, keepdims=True)


def rotated(x: Array, base: float = 10_000.0) -> Array:
    """RoFormer's rotation as multiplication of complex pairs, frame by frame."""
    half = x.shape[-1] // 2
    frequency = base ** (-np.arange(half) / half)
    turned = (x[..., :half] + 1j * x[..., half:]) * np.exp(1j * np.arange(len(x))[:, None] * frequency)
    return np.concatenate([turned.real, turned.imag], axis=-1)


@pytest.mark.parametrize("rotary", [False, True])
def test_attention_against_numpy(rotary: bool) -> None:
    torch.manual_seed(0)
    dim, context_dim, heads, frames, keys = 12, 7, 3, 5, 6
    attention = Attention(dim, context_dim, heads, rotary=rotary).double()
    x, context = torch.randn(2, frames, dim).double(), torch.randn(2, keys, context_dim).double()
    mask = torch.tensor([[True] * keys, [True, False, True, True, False, False]])
    result = attention(x, context, mask).detach().numpy()
    both = linear(attention.key_value, context.numpy())
    query, key, value = linear(attention.query, x.numpy()), both[..., :dim], both[..., dim:]
    size = dim // heads
    for clip in range(2):
        mixed = np.zeros((frames, dim))
        for head in range(heads):
            part = slice(head * size, (head + 1) * size)
            q, k = query[clip][:, part], key[clip][:, part]
            if rotary:
                q, k = rotated(q), rotated(k)
            scores = np.where(mask[clip].numpy(), q @ k.T / np.sqrt(size), -np.inf)
            mixed[:, part] = softmax(scores) @ value[clip][:, part]
        np.testing.assert_allclose(result[clip], linear(attention.out, mixed), atol=1e-6)


def test_rotary_scores_depend_on_distance_only() -> None:
    torch.manual_seed(0)
    rotary, frames = RotaryEmbedding(8), 50
    query, key = (torch.randn(8).expand(1, 1, frames, 8) for _ in range(2))
    scores = (rotary(query) @ rotary(key).transpose(-1, -2))[0, 0]
    torch.testing.assert_close(scores[1:, 1:], scores[:-1, :-1], rtol=0, atol=1e-4)
    assert scores[0].std() > 0.1  # and they do depend on it
    torch.testing.assert_close(rotary(query).norm(dim=-1), query.norm(dim=-1))
    np.testing.assert_allclose(rotary(query)[0, 0].numpy(), rotated(query[0, 0].numpy()), atol=1e-5)


def test_rotary_attention_notices_order_and_plain_attention_does_not() -> None:
    torch.manual_seed(0)
    x, context = torch.randn(1, 4, 16), torch.randn(1, 6, 16)
    for rotary in (False, True):
        attention = Attention(16, 16, 2, rotary=rotary)
        same = torch.allclose(attention(x, context), attention(x, context.flip(1)), atol=1e-5)
        assert same != rotary


def interpolated(values: Tensor, frames: int) -> Array:
    """Steps and frames are cells of the same stretch of time, each with its value at its centre."""
    steps = len(values)
    centres = (np.arange(steps) + 0.5) / steps
    wanted = (np.arange(frames) + 0.5) / frames
    columns = values.double().numpy().T
    return np.stack([np.interp(wanted, centres, column) for column in columns], axis=-1)


@pytest.mark.parametrize("frames", [(12, 7), (4, 11), (1, 1), (20, 14), (100, 3)], ids=str)
def test_interpolation_against_numpy(frames: tuple[int, int]) -> None:
    torch.manual_seed(0)
    lengths, features = (20, 7), 1e4 * torch.randn(2, 24, 3)  # what lies beyond a length must not be read
    for row, length in enumerate(lengths):
        features[row, :length] /= 1e4
    result = interpolate_frames(features, torch.tensor(lengths), torch.tensor(frames))
    assert result.shape == (2, max(frames), 3)
    for row in range(2):
        expected = interpolated(features[row, : lengths[row]], frames[row])
        np.testing.assert_allclose(result[row, : frames[row]].numpy(), expected, atol=1e-4)
        assert not result[row, frames[row] :].any()


@pytest.mark.parametrize("kind", [nn.GRU, nn.LSTM])
@pytest.mark.parametrize("bidirectional", [False, True])
def test_recurrent_networks_are_nodes_of_a_graph(
    kind: type[nn.GRU | nn.LSTM], bidirectional: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the format's own definition of the nodes they are PyTorch's networks, of several layers too."""
    torch.manual_seed(0)
    network = kind(5, 3, num_layers=2, batch_first=True, bidirectional=bidirectional).double()
    x = torch.randn(4, 6, 5, dtype=torch.float64)
    monkeypatch.setattr("torch.onnx.ops.symbolic", recurrent_node)
    torch.testing.assert_close(recurrent_nodes(network, x), network(x)[0], rtol=0, atol=1e-12)
