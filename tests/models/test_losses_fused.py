"""What a training step computes: the four losses of one draw, and in mixed precision something that is learnt from."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import lightning.pytorch as pl
import pytest
import torch

from facediff import registry
from facediff.data import Batch, collate
from facediff.models import DualPathDiffusion, losses
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]


@pytest.fixture
def model(ready: Make) -> DualPathDiffusion:
    return ready()


def test_losses_are_those_of_added_and_removed_noise(model: DualPathDiffusion, tiny: Tiny) -> None:
    dataset = tiny.dataset("train")
    batch = collate([dataset[0], dataset[3], dataset[7]])
    before, noise, step = batch.motion.clone(), torch.randn(3, batch.motion.shape[1], 72), torch.tensor([3, 20, 39])
    terms = model.losses_at(batch, step, noise.clone())
    assert torch.equal(batch.motion, before)
    clean = batch.motion.flatten(2) * model.scale
    noisy = model.process.add_noise(clean, noise, step)
    predicted = model.network(noisy, step, model.conditions(batch)).view(batch.motion.shape)
    truth, upper = clean.view(batch.motion.shape), model.assets.regions["upper_face"]
    expected = losses.training_losses(predicted, truth, batch.mask, upper, model.options.loss_weights)
    torch.testing.assert_close(terms, expected, rtol=1e-5, atol=1e-6)
    parameters = [p for p in model.parameters() if p.requires_grad]
    found, wanted = (torch.autograd.grad(each["loss"], parameters, allow_unused=True) for each in (terms, expected))
    for one, other in zip(found, wanted, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            torch.testing.assert_close(one, other, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("space", ["vertices", "components"])
def test_losses_of_several_draws_are_the_mean_of_each(
    space: str, make_model: Make, make_trainer: Callable[..., pl.Trainer], tiny: Tiny
) -> None:
    options = {"count": 6} if space == "components" else {}
    model = make_model(motion_space=partial(registry.motion_space.get(space), **options))
    make_trainer(max_steps=2).fit(model, datamodule=tiny)
    dataset = tiny.dataset("train")
    batch = collate([dataset[0], dataset[3]])
    shape = (4, batch.motion.shape[1], model.motion_space.coordinates)
    noise, step = torch.randn(*shape), torch.tensor([3, 30, 12, 39])  # two draws of the first clip, two of the second
    model.eval()
    both = model.losses_at(batch, step, noise.clone())
    each = [model.losses_at(batch, step[i::2], noise[i::2].clone()) for i in range(2)]
    for name in both:
        torch.testing.assert_close(both[name], (each[0][name] + each[1][name]) / 2, rtol=1e-4, atol=1e-7)


def test_a_training_step_noises_each_clip_as_often_as_asked(model: DualPathDiffusion, tiny: Tiny) -> None:
    seen: list[int] = []
    model.options.noise_draws = 3
    at = model.losses_at

    def count(batch: Batch, step: torch.Tensor, noise: torch.Tensor) -> dict[str, torch.Tensor]:
        seen.extend(step.tolist())
        assert len(noise) == len(step)
        return at(batch, step, noise)

    model.losses_at = count  # type: ignore[method-assign]
    dataset = tiny.dataset("train")
    model.losses(collate([dataset[i] for i in range(6)]))
    assert len(seen) == 18
    assert len(set(seen)) > 6  # each draw has a step of its own
