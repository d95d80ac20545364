"""What holds for every registered component of every kind."""

from __future__ import annotations

import io
from collections.abc import Callable

import pytest
import torch
from jaxtyping import TypeCheckError
from torch import Tensor, nn

from facediff import registry
from facediff.models.dual_path.conditioning import StyleTokens
from facediff.models.mesh_encoders import SpiralDown
from facediff.models.style_content.network import WindowedTransformer
from tests.fakes.onnx_nodes import recurrent_node

Make = Callable[..., nn.Module]
Call = Callable[..., tuple[Tensor, ...]]
DIM = 16
LENGTHS = (9, 21, 1, 40)
ALL = (0, 1, 2, 3)


@pytest.mark.parametrize("rows", [ALL, (2,), (1, 0)], ids=str)
def test_shape(kind: str, name: str, rows: tuple[int, ...], make: Make, call: Call) -> None:
    module = make(kind, name).eval()
    out = module(*call(kind, rows))
    assert out.dtype == torch.float32
    assert torch.isfinite(out).all()
    if kind in ("identity_encoder", "style_encoder"):
        assert out.shape == (len(rows), sum(module.token_dims))
    else:
        assert out.shape == (len(rows), max(LENGTHS[i] for i in rows), DIM)


def test_padding_changes_nothing(kind: str, name: str, make: Make, call: Call) -> None:
    module = make(kind, name).eval()
    together = module(*call(kind, ALL, extra=6, garbage=100.0))
    for i in ALL:
        alone = module(*call(kind, (i,)))[0]
        row = together[i] if kind in ("identity_encoder", "style_encoder") else together[i, : LENGTHS[i]]
        torch.testing.assert_close(row, alone, rtol=0, atol=1e-5)
        if kind == "audio_encoder":
            assert not together[i, LENGTHS[i] :].any()


GRAPHED = [(kind, name) for kind in ("audio_encoder", "decoder") for name in registry.KINDS[kind].names()]


@pytest.mark.parametrize("part", GRAPHED, ids="-".join)
def test_a_part_says_whether_its_graph_takes_padding(
    part: tuple[str, str], make: Make, call: Call, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A graph cannot look at lengths: it is right on clips of one length, and on padded ones where the part says so."""
    kind = part[0]
    module = make(*part).eval()
    expected = module(*call(kind, (1,)))[0]
    monkeypatch.setattr("torch.compiler.is_exporting", lambda: True)
    monkeypatch.setattr("torch.onnx.ops.symbolic", recurrent_node)
    torch.testing.assert_close(module(*call(kind, (1, 1)))[1], expected, rtol=0, atol=1e-5)
    padded = module(*call(kind, (1, 3)))[0, : LENGTHS[1]]
    takes_padding = module.takes_padding if kind == "audio_encoder" else module.graph_takes_padding
    assert torch.allclose(padded, expected, rtol=0, atol=1e-5) == takes_padding


def test_gradient_reaches_every_parameter(
    kind: str, name: str, make: Make, call: Call, without_dropout: Callable[[nn.Module], nn.Module]
) -> None:
    module = without_dropout(make(kind, name))
    out = module(*call(kind, ALL))
    if not list(module.parameters()):
        assert not out.requires_grad
        return
    (out - torch.randn_like(out)).square().sum().backward()
    idle = [
        name
        for name, parameter in module.named_parameters()
        if parameter.requires_grad and (parameter.grad is None or not parameter.grad.any())
    ]
    # A bias on the keys adds the same to every score of a query, which the softmax takes away again.
    assert [name for name in idle if not name.endswith("k_proj.bias")] == []
    assert all(torch.isfinite(p.grad).all() for p in module.parameters() if p.grad is not None)


def test_state_dict_round_trip(kind: str, name: str, make: Make, call: Call) -> None:
    one, other = make(kind, name, seed=0).eval(), make(kind, name, seed=1).eval()
    inputs = call(kind, ALL)
    expected = one(*inputs)
    assert torch.equal(other(*inputs), expected) == (not list(one.parameters()))
    file = io.BytesIO()
    torch.save(one.state_dict(), file)
    file.seek(0)
    other.load_state_dict(torch.load(file, weights_only=True))
    assert torch.equal(other(*inputs), expected)


def test_declared_shapes_are_enforced(kind: str, name: str, make: Make, call: Call) -> None:
    """The import hook of the tests checks the annotations; a component without any would let this pass."""
    inputs = call(kind, ALL)
    module = make(kind, name).eval()
    if type(module).__mro__[1].__module__.split(".")[0] != "facediff":
        pytest.skip("the hook covers facediff's own components only")
    with pytest.raises(TypeCheckError):
        module(*(tensor[..., None] for tensor in inputs))


def test_learnt_positions_and_tokens_start_small() -> None:
    """So that they do not drown the features at first, and what stands for a missing condition says nothing."""
    torch.manual_seed(0)
    style = registry.style_encoder.tcn_gru_transformer(dim=64, n_positions=128)
    window = WindowedTransformer(in_dim=4, dim=64, out_dim=4, window=128)
    for positions in (style.positions, window.positions):
        assert positions.shape == (128, 64)
        assert float(positions.detach().std()) == pytest.approx(0.02, rel=0.05)
        assert abs(float(positions.detach().mean())) < 1e-3
    assert not StyleTokens((), 8, "levels").null.any()  # type: ignore[union-attr]


def test_spiral_convolutions_start_as_glorot_has_it() -> None:
    torch.manual_seed(0)
    step = SpiralDown(40, 10, 9, 16, 32)
    weight = step.map.weight.detach()
    bound = (6 / (9 * 16 + 32)) ** 0.5
    assert weight.shape == (32, 9 * 16)
    assert 0.98 * bound < float(weight.abs().max()) <= bound
    assert float(weight.std()) == pytest.approx(bound / 3**0.5, rel=0.03)
    assert not step.map.bias.any()
