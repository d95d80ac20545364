"""Attention to a few tokens against attention as it is written."""

from __future__ import annotations

import pytest
import torch

from facediff.models.decoders import TokenAttention
from facediff.models.layers import Attention


@pytest.mark.parametrize("tokens", [1, 2, 3, 4, 9])
def test_token_attention_products_are_the_attention(tokens: int) -> None:
    torch.manual_seed(0)
    plain, narrow = Attention(16, 6, 4).double(), TokenAttention(16, 6, 4).double()
    narrow.load_state_dict(plain.state_dict())
    x, style = torch.randn(3, 7, 16, dtype=torch.float64), torch.randn(3, tokens, 6, dtype=torch.float64)
    torch.testing.assert_close(narrow(x, style), plain(x, style), rtol=0, atol=1e-12)
    for module in (plain, narrow):
        module(x, style).square().sum().backward()
    for one, other in zip(narrow.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, rtol=0, atol=1e-10)
