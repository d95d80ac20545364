"""The shared building blocks against NumPy and against the properties that they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from facediff.models.layers import (
    interpolate_frames,
    recurrent_nodes,
)
from tests.fakes.onnx_nodes import recurrent_node

Array = NDArray[np.float64]


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
