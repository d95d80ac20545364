"""The three-level identity embedding against equations 10 and 11."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from facediff.models.speaker_encoders import HierarchicalIdentity


@pytest.fixture
def encoder() -> HierarchicalIdentity:
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


def test_against_numpy(encoder: HierarchicalIdentity) -> None:
    result = encoder(torch.tensor([2, 0, 3])).detach().numpy()
    for row, identity in enumerate((2, 0, 3)):
        np.testing.assert_allclose(result[row], expected(encoder, identity), atol=1e-10)


def test_unseen_speaker_gets_the_mean(encoder: HierarchicalIdentity) -> None:
    result = encoder(torch.tensor([-1, 1])).detach().numpy()
    np.testing.assert_allclose(result[0], np.mean([expected(encoder, i) for i in range(4)], axis=0), atol=1e-10)
    np.testing.assert_allclose(result[1], expected(encoder, 1), atol=1e-10)
