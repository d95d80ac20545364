"""What a GPU computes is what the processor computes; skipped where there is none."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy

import pytest
import torch

from facediff.data import Batch
from facediff.models import DualPathDiffusion
from facediff.models.samplers import unit_noise
from tests.fakes.tiny import Tiny

pytestmark = [pytest.mark.cuda, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")]

Make = Callable[..., DualPathDiffusion]


@pytest.fixture
def pair(ready: Make, tiny: Tiny) -> tuple[DualPathDiffusion, DualPathDiffusion, Batch]:
    """A model on the processor, its twin on the GPU, and a batch."""
    model = ready()
    return model, deepcopy(model).to("cuda"), next(iter(tiny.train_dataloader()))


def test_losses_and_gradients_on_a_gpu_are_those_of_the_processor(
    pair: tuple[DualPathDiffusion, DualPathDiffusion, Batch],
) -> None:
    model, twin, batch = pair
    steps = model.process.draw_steps(len(batch), torch.device("cpu"))
    noise = torch.randn(batch.motion.flatten(2).shape)
    copy = noise.to("cuda", copy=True)  # both overwrite theirs
    mine = model.losses_at(batch, steps, noise)
    theirs = twin.losses_at(batch.to("cuda"), steps.cuda(), copy)
    for name, value in mine.items():
        torch.testing.assert_close(theirs[name].cpu(), value, rtol=1e-3, atol=1e-5)
    mine["loss"].backward()
    theirs["loss"].backward()
    for (name, one), other in zip(model.named_parameters(), twin.parameters(), strict=True):
        if one.grad is not None:
            assert other.grad is not None, name
            torch.testing.assert_close(other.grad.cpu(), one.grad, rtol=1e-2, atol=1e-4, msg=name)


@pytest.mark.parametrize("space", ["folded", "vertices"])
def test_motion_of_a_gpu_is_that_of_the_processor(
    space: str, pair: tuple[DualPathDiffusion, DualPathDiffusion, Batch]
) -> None:
    model, twin, batch = pair
    model.options.sampling_space = twin.options.sampling_space = space  # type: ignore[assignment]
    mine = model.generate(batch, seed=3)
    theirs = twin.generate(batch.to("cuda"), seed=3).cpu()
    torch.testing.assert_close(theirs, mine, rtol=1e-2, atol=1e-2 * float(mine.abs().max()))


def test_half_precision_on_a_gpu_keeps_the_prediction_in_float32(
    pair: tuple[DualPathDiffusion, DualPathDiffusion, Batch],
) -> None:
    _, twin, batch = pair
    with torch.autocast("cuda", torch.bfloat16):
        found = twin.losses_at(
            batch.to("cuda"),
            twin.process.draw_steps(len(batch), twin.device),
            unit_noise(batch.motion.flatten(2).shape, twin.device),
        )
    assert found["loss"].dtype == torch.float32
    found["loss"].backward()
    assert all(torch.isfinite(p.grad).all() for p in twin.parameters() if p.grad is not None)
