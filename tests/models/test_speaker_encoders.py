"""Encoders of styles and identities: their formulas against NumPy, and padding that never counts."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from facediff.models.speaker_encoders import HierarchicalIdentity, LstmStyle, TcnGruTransformer

DIM = 6


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


@pytest.mark.parametrize("causal", [True, False])
def test_centred_convolutions_do_not_reach_into_the_padding(causal: bool) -> None:
    torch.manual_seed(0)
    encoder = TcnGruTransformer(dim=DIM, num_heads=2, causal=causal).eval()
    reference = torch.randn(1, 20, DIM)
    expected = encoder(reference, torch.ones(1, 20, dtype=torch.bool))
    longer = torch.cat([reference, 100 * torch.randn(1, 40, DIM)], dim=1)
    torch.testing.assert_close(encoder(longer, torch.arange(60)[None] < 20), expected, rtol=0, atol=1e-5)


@pytest.fixture
def recurrent() -> LstmStyle:
    torch.manual_seed(0)
    return LstmStyle(dim=DIM, style_dim=5)


def test_lstm_style_is_the_state_after_the_last_frame(recurrent: LstmStyle) -> None:
    reference, mask = torch.randn(3, 9, DIM), torch.arange(9)[None] < torch.tensor([[9], [4], [1]])
    style = recurrent(reference, mask)
    assert style.shape == (3, 5) == (3, sum(recurrent.token_dims))
    for row, length in enumerate((9, 4, 1)):
        torch.testing.assert_close(style[row], recurrent.lstm(reference[row : row + 1, :length])[0][0, -1])


def test_lstm_padding_that_is_not_finite_changes_nothing(recurrent: LstmStyle) -> None:
    reference, mask = torch.randn(2, 8, DIM), torch.arange(8)[None] < torch.tensor([[8], [5]])
    expected = recurrent(reference, mask)
    spoilt = reference.masked_fill(~mask[..., None], torch.nan)
    style = recurrent(spoilt, mask)
    assert torch.equal(style, expected)
    style.square().sum().backward()
    assert all(torch.isfinite(p.grad).all() and p.grad.any() for p in recurrent.parameters())


def test_lstm_mean_pooling_omits_padding() -> None:
    torch.manual_seed(0)
    encoder = LstmStyle(dim=DIM, style_dim=5, pooling="mean")
    reference, mask = torch.randn(2, 8, DIM), torch.arange(8)[None] < torch.tensor([[8], [5]])
    style, states = encoder(reference, mask), encoder.lstm(reference)[0]
    torch.testing.assert_close(style, torch.stack([states[0].mean(0), states[1, :5].mean(0)]), rtol=0, atol=1e-6)


@pytest.fixture
def identities() -> HierarchicalIdentity:
    torch.manual_seed(0)
    made = HierarchicalIdentity(dim=8, n_identities=4, level_dim=3)
    torch.nn.init.normal_(made.norm.weight)
    torch.nn.init.normal_(made.norm.bias)
    return made.double()


def expected(encoder: HierarchicalIdentity, identity: int) -> np.ndarray:
    parts = [table.weight[identity].detach().numpy() for table in (encoder.coarse, encoder.mid, encoder.fine)]
    weight, bias = encoder.attention.weight.detach().numpy(), encoder.attention.bias.detach().numpy()
    scores = np.exp(weight @ np.concatenate(parts) + bias)
    beta = scores / scores.sum()  # eq. 10
    joined = np.concatenate([b * part for b, part in zip(beta, parts, strict=True)])
    normed = (joined - joined.mean()) / np.sqrt(joined.var() + 1e-5)
    return normed * encoder.norm.weight.detach().numpy() + encoder.norm.bias.detach().numpy()  # eq. 11


def test_identities_are_eq_10_and_11(identities: HierarchicalIdentity) -> None:
    result = identities(torch.tensor([2, 0, 3])).detach().numpy()
    for row, identity in enumerate((2, 0, 3)):
        np.testing.assert_allclose(result[row], expected(identities, identity), atol=1e-10)


def test_unseen_speaker_gets_the_mean(identities: HierarchicalIdentity) -> None:
    result = identities(torch.tensor([-1, 1])).detach().numpy()
    np.testing.assert_allclose(result[0], np.mean([expected(identities, i) for i in range(4)], axis=0), atol=1e-10)
    np.testing.assert_allclose(result[1], expected(identities, 1), atol=1e-10)
