"""The shared building blocks against NumPy and against the properties that they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from facediff.models.layers import (
    RotaryEmbedding,
    interpolate_frames,
    recurrent_nodes,
)
from tests.fakes.onnx_nodes import recurrent_node

Array = NDArray[np.float64]


def rotated(x: Array, base: float = 10_000.0) -> Array:
    """RoFormer's rotation as multiplication of complex pairs, frame by frame."""
    half = x.shape[-1] // 2
    frequency = base ** (-np.arange(half) / half)
    turned = (x[..., :half] + 1j * x[..., half:]) * np.exp(1j * np.arange(len(x))[:, None] * frequency)
    return np.concatenate([turned.real, turned.imag], axis=-1)


def test_rotary_scores_depend_on_distance_only() -> None:
    torch.manual_seed(0)
    rotary, frames = RotaryEmbedding(8), 50
    query, key = (torch.randn(8).expand(1, 1, frames, 8) for _ in range(2))
    scores = (rotary(query) @ rotary(key).transpose(-1, -2))[0, 0]
    torch.testing.assert_close(scores[1:, 1:], scores[:-1, :-1], rtol=0, atol=1e-4)
    assert scores[0].std() > 0.1  # and they do depend on it
    torch.testing.assert_close(rotary(query).norm(dim=-1), query.norm(dim=-1))
    np.testing.assert_allclose(rotary(query)[0, 0].numpy(), rotated(query[0, 0].numpy()), atol=1e-5)


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
