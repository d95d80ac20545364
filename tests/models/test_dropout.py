"""Where dropout acts: with probability one each residual branch is silent in training, and whole in evaluation."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor, nn

from facediff.models.audio_encoders import MelEncoder
from facediff.models.decoders import DecoderBlock, GruDecoder, StyleTransformer
from facediff.models.fusions import BidirectionalCrossAttention
from facediff.models.layers import Attention
from facediff.models.speaker_encoders import EncoderLayer, TcnGruTransformer, TemporalBlock

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


def test_dropout_of_the_style_encoders_layers(x: Tensor) -> None:
    layer = EncoderLayer(DIM, 2, 1.0)
    assert torch.equal(layer(x, MASK), x)
    assert not torch.allclose(layer.eval()(x, MASK), x)
    assert layer.attention.dropout == layer.feed_forward[2].p == 1.0
    for branch, last in (("attention", "out"), ("feed_forward", "3")):
        layer = EncoderLayer(DIM, 2, 0.5)
        layer.attention.dropout, layer.feed_forward[2].p = 0.0, 0.0
        for name, end in (("attention", "out"), ("feed_forward", "3")):
            linear = layer.get_submodule(f"{name}.{end}")
            nn.init.zeros_(linear.weight)  # type: ignore[arg-type]
            nn.init.constant_(linear.bias, 3.0 if (name, end) == (branch, last) else 0.0)  # type: ignore[arg-type]
        assert set((layer(x, MASK) - x).detach().round(decimals=4).unique().tolist()) == {0.0, 6.0}


def test_dropout_of_a_tcn_branch_follows_each_convolution(x: Tensor) -> None:
    block = TemporalBlock(DIM, 2, 3, causal=True, dropout=1.0)
    assert torch.equal(block(x, MASK[..., None]), x.relu())
    calls: list[Tensor] = []
    block = TemporalBlock(DIM, 2, 3, causal=True, dropout=0.5)
    block.dropout.register_forward_hook(lambda _, args, out: calls.append(out))
    out = block(x, MASK[..., None])
    assert len(calls) == 2
    torch.testing.assert_close(out, (x + calls[1]).relu())


def test_dropout_of_the_fusion_silences_both_attentions(x: Tensor) -> None:
    fusion, motion = BidirectionalCrossAttention(dim=DIM, num_heads=2, dropout=1.0), torch.randn(2, 5, DIM)
    assert torch.equal(fusion(x, motion, MASK), x + motion)
    assert not torch.allclose(fusion.eval()(x, motion, MASK), x + motion)
    fusion = BidirectionalCrossAttention(dim=DIM, num_heads=2, dropout=0.5)
    for attention in (fusion.audio_from_motion, fusion.motion_from_audio):
        nn.init.zeros_(attention.out.weight)
        nn.init.constant_(attention.out.bias, 3.0)
    added = fusion(x, motion, MASK) - x - motion
    # Two branches, each 0 or 6.
    assert set(added.detach().round(decimals=4).unique().tolist()) == {0.0, 6.0, 12.0}


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
