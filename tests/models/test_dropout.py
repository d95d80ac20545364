"""Where dropout acts: with probability one each residual branch is silent in training, and whole in evaluation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from facediff.models.audio_encoders import MelEncoder
from facediff.models.decoders import DecoderBlock, GruDecoder, StyleTransformer
from facediff.models.fusions import BidirectionalCrossAttention
from facediff.models.layers import Attention
from facediff.models.speaker_encoders import TcnGruTransformer

DIM = 8
MASK = torch.ones(2, 5, dtype=torch.bool)


@pytest.fixture
def x() -> Tensor:
    torch.manual_seed(0)
    return torch.randn(2, 5, DIM)


def test_dropout_of_a_decoder_block_silences_its_three_branches(x: Tensor) -> None:
    block = DecoderBlock(DIM, 6, 2, 16, 1.0)
    style = torch.randn(2, 3, 6)
    assert torch.equal(block(x, style, MASK, None), x)
    assert not torch.allclose(block.eval()(x, style, MASK, None), x)
    assert (block.time_attention.dropout, block.style_attention.dropout) == (1.0, 0.0)
    assert block.feed_forward[2].p == 1.0


def test_dropout_of_attention_is_on_its_weights(x: Tensor) -> None:
    attention = Attention(DIM, DIM, 2, dropout=1.0)
    torch.testing.assert_close(attention(x, x), attention.out.bias.expand(2, 5, DIM))
    half = Attention(DIM, DIM, 2, dropout=0.5)
    nn.init.zeros_(half.query.weight)
    nn.init.zeros_(half.query.bias)  # equal weights of 1/5: those that are kept become 2/5
    nn.init.zeros_(half.key_value.weight)
    nn.init.ones_(half.key_value.bias)
    nn.init.eye_(half.out.weight)
    nn.init.zeros_(half.out.bias)
    levels = set((half(x, x) * 5 / 2).detach().round(decimals=4).unique().tolist())
    assert levels <= {0.0, 1.0, 2.0, 3.0, 4.0, 5.0}
    assert len(levels) > 2
    torch.testing.assert_close(half.eval()(x, x), torch.ones(2, 5, DIM))


def test_dropout_reaches_every_part() -> None:
    """By one number per component; the recurrent decoder drops between layers only."""
    for module in (
        StyleTransformer(dim=DIM, style_dim=6, num_layers=2, num_heads=2, dropout=0.37),
        TcnGruTransformer(dim=DIM, num_heads=2, num_layers=2, dropout=0.37),
        BidirectionalCrossAttention(dim=DIM, num_heads=2, dropout=0.37),
        MelEncoder(dim=DIM, hidden_dim=4, num_layers=2, dropout=0.37),
    ):
        shares = [part.p for part in module.modules() if isinstance(part, nn.Dropout)]
        assert shares
        assert set(shares) == {0.37}
        inside = [part.dropout for part in module.modules() if type(part) is Attention]
        assert set(inside) <= ({0.0} if isinstance(module, BidirectionalCrossAttention) else {0.37})
    assert GruDecoder(dim=DIM, style_dim=6, num_layers=2, dropout=0.37).gru.dropout == 0.37
    assert GruDecoder(dim=DIM, style_dim=6, num_layers=1, dropout=0.37).gru.dropout == 0.0
