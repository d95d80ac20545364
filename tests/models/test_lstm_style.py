"""The recurrent style encoder: its state at a frame knows that frame and the past, and nothing else."""

from __future__ import annotations

import pytest
import torch

from facediff.models.speaker_encoders import LstmStyle

DIM, STYLE = 6, 5


def step(lstm: torch.nn.LSTM, x: torch.Tensor, hidden: torch.Tensor, cell: torch.Tensor) -> tuple[torch.Tensor, ...]:
    """One step of an LSTM (Hochreiter and Schmidhuber 1997, with forget gates), written out."""
    gates = lstm.weight_ih_l0 @ x + lstm.bias_ih_l0 + lstm.weight_hh_l0 @ hidden + lstm.bias_hh_l0
    entry, forget, new, out = gates.chunk(4)
    cell = torch.sigmoid(forget) * cell + torch.sigmoid(entry) * torch.tanh(new)
    return torch.sigmoid(out) * torch.tanh(cell), cell


@pytest.fixture
def encoder() -> LstmStyle:
    torch.manual_seed(0)
    return LstmStyle(dim=DIM, style_dim=STYLE)


def test_lstm_style_is_the_state_after_the_last_frame(encoder: LstmStyle) -> None:
    reference, mask = torch.randn(3, 9, DIM), torch.arange(9)[None] < torch.tensor([[9], [4], [1]])
    style = encoder(reference, mask)
    assert style.shape == (3, STYLE) == (3, sum(encoder.token_dims))
    for row, length in enumerate((9, 4, 1)):
        hidden, cell = torch.zeros(STYLE), torch.zeros(STYLE)
        for x in reference[row, :length]:
            hidden, cell = step(encoder.lstm, x, hidden, cell)
        torch.testing.assert_close(style[row], hidden, rtol=0, atol=1e-6)


def test_lstm_padding_that_is_not_finite_changes_nothing(encoder: LstmStyle) -> None:
    reference, mask = torch.randn(2, 8, DIM), torch.arange(8)[None] < torch.tensor([[8], [5]])
    expected = encoder(reference, mask)
    spoilt = reference.masked_fill(~mask[..., None], torch.nan)
    style = encoder(spoilt, mask)
    assert torch.equal(style, expected)
    style.square().sum().backward()
    assert all(torch.isfinite(p.grad).all() and p.grad.any() for p in encoder.parameters())


def test_lstm_mean_pooling_omits_padding() -> None:
    torch.manual_seed(0)
    encoder = LstmStyle(dim=DIM, style_dim=STYLE, pooling="mean")
    reference, mask = torch.randn(2, 8, DIM), torch.arange(8)[None] < torch.tensor([[8], [5]])
    style, states = encoder(reference, mask), encoder.states(reference, mask)
    torch.testing.assert_close(style[0], states[0].mean(0), rtol=0, atol=1e-6)
    torch.testing.assert_close(style[1], states[1, :5].mean(0), rtol=0, atol=1e-6)
