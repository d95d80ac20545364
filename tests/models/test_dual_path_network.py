"""What does not change over the denoising steps: computed once, and the same as if it were computed in every step."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from facediff.models.decoders import Decoder
from facediff.models.dual_path.conditioning import Conditions
from facediff.models.dual_path.network import ConditionalDenoiser
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]
DIM, FRAMES = 16, 12


class Unprepared(Decoder):
    """A decoder of another package that prepares nothing and has no ``prepared`` argument."""

    def __init__(self, *, dim: int, style_dim: int) -> None:
        super().__init__()
        self.style = nn.Linear(style_dim, dim)

    def forward(self, fused: Tensor, style: Tensor, mask: Tensor) -> Tensor:
        return fused + self.style(style.mean(1, keepdim=True))


VARIANTS: list[dict[str, Any]] = [{"decoder": registry.decoder.get(name)} for name in registry.decoder.names()]
VARIANTS += [{"fusion": registry.fusion.get(name)} for name in registry.fusion.names()]
VARIANTS += [
    {"fusion": partial(registry.fusion.cross_attention, rotary=False)},
    {"style_tokens": "single"},
    # As many pairs of head and token as channels: keys and values are not multiplied out.
    {"decoder": partial(registry.decoder.style_transformer, num_layers=1, num_heads=4), "dim": 8},
    # Of another package, without prepare.
    {"decoder": Unprepared},
]


def conditions(dim: int, frames: int = FRAMES, padded: int = 0) -> Conditions:
    mask = torch.arange(frames)[None] < torch.tensor([[frames], [frames - padded]])
    return Conditions(torch.randn(2, frames, dim).double(), torch.randn(2, 3, dim).double(), mask)


@pytest.mark.parametrize("variant", VARIANTS, ids=str)
@pytest.mark.parametrize("padded", [0, 5])
def test_prepared_conditions_give_the_same_features(make_model: Make, variant: dict[str, Any], padded: int) -> None:
    model = make_model(**variant).double().eval()
    network, dim = model.network, variant.get("dim", DIM)
    given = conditions(dim, padded=padded)
    for known in (given, given.frames(torch.arange(2, 9))):
        space = network.prepare_for_inference(known, model.process.steps, folded=False)
        for step in (0, 17, model.process.steps - 1):
            motion, steps = torch.randn(*known.audio.shape).double(), torch.tensor([step, step])
            with torch.no_grad():
                out, expected = space.features(motion, step), network.core(motion, steps, known)
            torch.testing.assert_close(out[known.mask], expected[known.mask], rtol=0, atol=1e-12)


def test_step_table_is_kept_until_the_weights_change(make_model: Make) -> None:
    network = make_model().eval().network
    given = Conditions(torch.randn(1, FRAMES, DIM), torch.randn(1, 3, DIM), torch.ones(1, FRAMES, dtype=torch.bool))

    def table(steps: int = 40) -> Tensor:
        denoiser: ConditionalDenoiser = network.prepare_for_inference(given, steps, folded=True)
        found = denoiser.conditions.step_table  # type: ignore[attr-defined]
        assert isinstance(found, Tensor)
        return found

    with torch.inference_mode():
        first = table()
    torch.testing.assert_close(first, network.step_embedding(torch.arange(40)).detach(), rtol=0, atol=1e-6)
    assert table() is first
    assert len(table(50)) == 50
    # As weight averages are swapped in: without a trace in any counter.
    network.step_embedding.mlp[2].bias.data.add_(1.0)
    torch.testing.assert_close(table(), first + 1.0)
    assert not [name for name in network.state_dict() if "of_weights" in name or "table" in name]
    # It can be used where gradients are computed, though it carries none and was made in inference mode.
    (first * torch.ones(DIM, requires_grad=True)).sum().backward()


@pytest.mark.parametrize("part", ["audio_encoder", "style_encoder", "fusion", "decoder"])
def test_a_component_that_gives_another_shape_is_named(part: str, make_model: Make, tiny: Tiny) -> None:
    """In training and inference."""
    model = make_model()
    model.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
    component = getattr(model.network, part)
    component.register_forward_hook(lambda *values: values[-1][..., 1:])
    batch = collate([tiny.dataset("val")[0]])
    for use in (model.losses, model.generate):
        with pytest.raises(FaceDiffError, match=rf"^{type(component).__name__}: .*shape .*{DIM}"):
            use(batch)
