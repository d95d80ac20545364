"""The dynamic style encoder against equations 2, 7 and 8, and its positions at any length."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn.utils.rnn import pad_packed_sequence

from facediff.models.speaker_encoders import AttentionPooling, TcnGruTransformer, TemporalBlock

DIM = 6
Array = NDArray[np.float64]


def convolved(conv: nn.Module, x: Array, dilation: int, *, causal: bool) -> Array:
    """A weight-normalised dilated convolution over time, tap by tap; outside the clip is silence."""
    original = conv.parametrizations.weight
    gain, direction = (p.detach().double().numpy() for p in (original.original0, original.original1))
    weight = gain * direction / np.sqrt((direction**2).sum((1, 2), keepdims=True))
    taps = weight.shape[2]
    out = np.tile(conv.bias.detach().double().numpy(), (len(x), 1))
    for t in range(len(x)):
        for k in range(taps):
            source = t + (k - (taps - 1) if causal else k - (taps - 1) // 2) * dilation
            if 0 <= source < len(x):
                out[t] += weight[:, :, k] @ x[source]
    return out


def branch(block: TemporalBlock, x: Array, dilation: int, *, causal: bool) -> Array:
    hidden = np.maximum(convolved(block.first, x, dilation, causal=causal), 0)
    hidden = np.maximum(convolved(block.second, hidden, dilation, causal=causal), 0)
    return np.maximum(x + hidden, 0)


@pytest.mark.parametrize("causal", [True, False])
def test_tcn_branches_mean_against_numpy(causal: bool) -> None:
    torch.manual_seed(0)
    encoder = TcnGruTransformer(dim=DIM, num_heads=2, causal=causal).eval()
    entering: list[torch.Tensor] = []
    encoder.gru.register_forward_pre_hook(
        lambda _, args: entering.append(pad_packed_sequence(args[0], batch_first=True)[0])
    )
    lengths = (40, 23)
    reference = torch.randn(2, 40, DIM)
    encoder(reference, torch.arange(40)[None] < torch.tensor(lengths)[:, None])
    for row, length in enumerate(lengths):
        x = reference[row, :length].double().numpy()
        dilations = (1, 2, 4, 8, 16)
        parts = [branch(b, x, d, causal=causal) for b, d in zip(encoder.branches, dilations, strict=True)]
        np.testing.assert_allclose(entering[0][row, :length].detach().numpy(), np.mean(parts, axis=0), atol=1e-5)


def test_pooling_against_numpy() -> None:
    torch.manual_seed(0)
    pooling = AttentionPooling(DIM).double()
    features, mask = torch.randn(3, 7, DIM).double(), torch.arange(7)[None] < torch.tensor([[7], [4], [1]])
    weights, pooled = pooling.weights(features, mask), pooling(features, mask).detach().numpy()
    assert not weights[~mask].any()
    torch.testing.assert_close(weights.sum(1), torch.ones(3).double())
    for row, length in enumerate((7, 4, 1)):
        f = features[row, :length].numpy()
        hidden = np.tanh(f @ pooling.hidden.weight.detach().numpy().T + pooling.hidden.bias.detach().numpy())
        scores = np.exp(hidden @ pooling.score.weight.detach().numpy()[0])
        gamma = scores / scores.sum()
        np.testing.assert_allclose(weights[row, :length].detach().numpy(), gamma, atol=1e-12)
        np.testing.assert_allclose(pooled[row], gamma @ f, atol=1e-12)


def test_statistics_against_numpy() -> None:
    """With the other layers silent, F_dyn is the map of means and deviations of each clip's own frames."""
    torch.manual_seed(0)
    encoder = TcnGruTransformer(dim=DIM, num_heads=2, statistics=True).eval()
    for parameter in encoder.mlp.parameters():
        nn.init.zeros_(parameter)
    lengths = (7, 1)
    reference = torch.randn(2, 7, DIM)
    style = encoder(reference, torch.arange(7)[None] < torch.tensor(lengths)[:, None]).detach().numpy()
    last = encoder.statistics
    assert last is not None
    for row, length in enumerate(lengths):
        own = reference[row, :length].numpy()
        facts = np.concatenate([own.mean(0), np.sqrt(own.var(0) + 1e-4)])
        np.testing.assert_allclose(
            style[row], last.weight.detach().numpy() @ facts + last.bias.detach().numpy(), atol=1e-5
        )


@pytest.mark.parametrize("frames", [1, 5, 64, 300])
def test_positions_serve_any_length(frames: int) -> None:
    """With a silent GRU and no layers only the positions are left."""
    encoder = TcnGruTransformer(dim=DIM, num_layers=0, n_positions=64).eval()
    for parameter in encoder.gru.parameters():
        nn.init.zeros_(parameter)
    encoder.norm = nn.Identity()
    nn.init.normal_(encoder.positions)
    mask = torch.arange(frames + 3)[None] < frames
    features = encoder.features(torch.randn(1, frames + 3, DIM), mask)[0, :frames].detach().numpy()
    centres, wanted = (np.arange(64) + 0.5) / 64, (np.arange(frames) + 0.5) / frames
    table = encoder.positions.detach().numpy()
    expected = np.stack([np.interp(wanted, centres, table[:, c]) for c in range(DIM)], axis=-1)
    np.testing.assert_allclose(features, expected, atol=1e-4)


@pytest.mark.parametrize("causal", [True, False])
def test_centred_convolutions_do_not_reach_into_the_padding(causal: bool) -> None:
    torch.manual_seed(0)
    encoder = TcnGruTransformer(dim=DIM, num_heads=2, causal=causal).eval()
    reference = torch.randn(1, 20, DIM)
    expected = encoder(reference, torch.ones(1, 20, dtype=torch.bool))
    longer = torch.cat([reference, 100 * torch.randn(1, 40, DIM)], dim=1)
    torch.testing.assert_close(encoder(longer, torch.arange(60)[None] < 20), expected, rtol=0, atol=1e-5)


def test_both_ends_of_the_reference_count() -> None:
    torch.manual_seed(0)
    encoder = TcnGruTransformer(dim=DIM, num_heads=2).eval()
    reference = torch.randn(1, 30, DIM, requires_grad=True)
    encoder(reference, torch.ones(1, 30, dtype=torch.bool)).sum().backward()
    assert reference.grad is not None
    assert (reference.grad[0].abs().sum(1) > 0).all()


def test_odd_widths_are_refused() -> None:
    with pytest.raises(ValueError, match=r"model\.dim 5: .*even"):
        TcnGruTransformer(dim=5)
