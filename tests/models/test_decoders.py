"""What the method asks of decoders and fusions in addition to the laws of every component."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

from facediff.models.decoders import GruDecoder, StyleTransformer, TokenAttention
from facediff.models.layers import Attention

DIM, FRAMES = 16, 12


def reach(function: Callable[[Tensor], Tensor], frames: int = FRAMES) -> Tensor:
    """Which output frame (row) depends on which input frame (column)."""
    x = torch.randn(1, frames, DIM, requires_grad=True)
    out = function(x)
    rows = [torch.autograd.grad(out[0, t].square().sum(), x, retain_graph=True)[0][0] for t in range(frames)]
    return torch.stack(rows).abs().sum(-1) > 0


@pytest.fixture(params=[GruDecoder, StyleTransformer])
def decoder(request: pytest.FixtureRequest) -> nn.Module:
    torch.manual_seed(0)
    made: nn.Module = request.param(dim=DIM, style_dim=6, num_layers=1).eval()
    return made


MASK = torch.ones(1, FRAMES, dtype=torch.bool)
STYLE = torch.randn(1, 3, 6, generator=torch.Generator().manual_seed(0))


def test_the_last_norm_takes_each_frames_size_away_and_can_be_left_out() -> None:
    fused = torch.randn(1, FRAMES, DIM) * torch.linspace(1, 9, FRAMES)[:, None]
    with_norm, without = (StyleTransformer(dim=DIM, style_dim=6, num_layers=0, final_norm=f) for f in (True, False))
    assert torch.equal(without(fused, STYLE, MASK), fused)
    assert not list(without.parameters())
    sizes = with_norm(fused, STYLE, MASK).square().mean(-1).sqrt()
    torch.testing.assert_close(sizes, torch.ones_like(sizes), rtol=1e-3, atol=0)


def test_decoder_frame_sees_past_and_future(decoder: nn.Module) -> None:
    assert reach(lambda x: decoder(x, STYLE, MASK)).all()


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
