"""The dynamic style encoder against equations 2, 7 and 8, and its positions at any length."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import nn

from facediff.models.speaker_encoders import TcnGruTransformer

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
