"""The dual-path model: conditions, losses, sampling, ablations."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import pytest
import torch

from facediff import registry
from facediff.data import collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]


@pytest.fixture
def model(ready: Make) -> DualPathDiffusion:
    return ready()


def test_the_prediction_of_a_clip_does_not_depend_on_its_padding(model: DualPathDiffusion, tiny: Tiny) -> None:
    dataset = tiny.dataset("train")
    short, long = dataset[0], dataset[7]
    alone, together = collate([short]), collate([short, long])
    frames = len(short.motion)
    noise = torch.randn(1, frames, 72)
    clean = alone.motion.flatten(2) * model.scale
    step = torch.tensor([20])
    noisy = model.process.add_noise(clean, noise, step)
    padded = torch.randn(2, together.motion.shape[1], 72)
    padded[:1, :frames] = noisy
    first = model.network(noisy, step, model.conditions(alone))
    second = model.network(padded, step.expand(2), model.conditions(together))
    torch.testing.assert_close(second[:1, :frames], first, atol=1e-4, rtol=1e-4)


@pytest.mark.parametrize(
    "override",
    [
        {},
        {"style_encoder": registry.style_encoder.none},
        {"identity_encoder": registry.identity_encoder.none},
        {"fusion": registry.fusion.add},
        {"style_tokens": "single"},
        {"template_token": True},
        {"decoder": registry.decoder.gru},
        {"style_encoder": registry.style_encoder.none, "identity_encoder": registry.identity_encoder.none},
    ],
    ids=["full", "no_style", "no_identity", "add", "single_token", "template_token", "gru", "no_condition"],
)
def test_every_trainable_parameter_gets_a_gradient(make_model: Make, tiny: Tiny, override: dict[str, object]) -> None:
    model = make_model(**override)
    model.adopt(tiny.assets().with_motion_scale(1.0))
    dataset = tiny.dataset("train")
    model.losses(collate([dataset[0], dataset[5]]))["loss"].backward()
    missing = [name for name, p in model.named_parameters() if p.requires_grad and p.grad is None]
    # With a single style token softmax over one key is constant, so its key half of the projection stays zero,
    # but it is still reached.
    assert missing == []


def test_ablations_leave_their_part_out(make_model: Make) -> None:
    full, bare = make_model(), make_model(style_encoder=registry.style_encoder.none)
    assert len(full.network.style_tokens.projections) == 4
    assert len(bare.network.style_tokens.projections) == 3
    assert bare.network.mesh_encoder is None
    assert len(make_model(style_tokens="single").network.style_tokens.projections) == 1


def test_the_neutral_face_is_a_token_of_what_it_has_of_its_own(make_model: Make, tiny: Tiny) -> None:
    model = make_model(template_token=True)
    model.adopt(tiny.assets().with_motion_scale(1.0))
    model.measure(tiny)
    own, token = collate([tiny.dataset("val")[0]]), model.network.template_token
    assert token is not None
    faces = torch.stack([model.assets.template(name) for name in model.identities])
    expected = (faces - faces.mean(0)) / (faces - faces.mean(0)).square().mean().sqrt()
    for face, whole in zip(faces, expected, strict=True):
        last = model.conditions(replace(own, template=face[None])).style[:, -1]
        torch.testing.assert_close(last[0], token.project(whole.flatten()), atol=1e-5, rtol=1e-4)
    other = replace(own, template=own.template + 0.1 * torch.rand_like(own.template))
    assert not torch.allclose(model.eval().generate_clips(own), model.generate_clips(other))
    plain = make_model()
    plain.adopt(tiny.assets().with_motion_scale(1.0))
    torch.testing.assert_close(plain.eval().generate_clips(own), plain.generate_clips(other))
    with pytest.raises(FaceDiffError, match="template_token"):
        model.graphs()


def test_animate_is_seeded_and_knows_unseen_people(model: DualPathDiffusion) -> None:
    speech = torch.randn(16_000)
    first = model.animate(speech, identity="A", seed=1)
    assert first.vertices.shape == (25, 24, 3)
    assert torch.equal(first.vertices, model.animate(speech, identity="A", seed=1).vertices)
    assert not torch.equal(first.vertices, model.animate(speech, identity="A", seed=2).vertices)
    assert model.animate(speech, identity="C").identity == "unknown"
    with pytest.raises(FaceDiffError, match='there is no identity "Z": known are A, B, C'):
        model.animate(speech, identity="Z")


def test_another_sampler_keeps_spacing_and_last_noise_where_its_steps_allow(make_model: Make) -> None:
    spaced = {"spacing": "log_snr", "last_noise": 0.5}
    model = make_model(sampler=partial(registry.sampler.ddim, steps=4, **spaced))
    own = model.sampler.timesteps
    model.choose_sampler("dpm_solver", 4)
    assert model.sampler.timesteps == own
    model.choose_sampler("ddpm")
    assert model.sampler.timesteps == [*range(model.process.steps)][::-1]
    with pytest.raises(FaceDiffError, match="steps"):
        model.choose_sampler("ddpm", model.process.steps + 1)


@pytest.mark.parametrize("name", [None, "ddim"])
def test_fewer_steps_end_at_more_noise(make_model: Make, name: str | None) -> None:
    made = {"steps": 10, "spacing": "log_snr", "first_noise": 200.0, "last_noise": 2.0}
    model = make_model(diffusion_steps=1000, sampler=partial(registry.sampler.dpm_solver, **made))

    def last_noise(steps: int | None) -> float:
        model.choose_sampler(name, steps)
        kept = model.sampler.signal[-2]
        return math.sqrt((1 - kept) / kept)

    ends = [last_noise(steps) for steps in (2, 3, 5, 10, 20)]
    assert ends == sorted(ends, reverse=True)
    assert ends[0] > 5 * ends[3]
    assert ends[3:] == pytest.approx([2.0, 2.0], rel=0.02)  # as it was made, where the steps are as many or more
    model.choose_sampler("dpm_solver")  # whose own number is 5
    own = model.sampler.timesteps
    model.choose_sampler("dpm_solver", 5)
    assert model.sampler.timesteps == own
    model.choose_sampler("ddim", 4)
    model.choose_sampler(steps=2)  # of the sampler that was chosen
    assert (type(model.sampler).__name__, model.sampler.steps) == ("DdimSampler", 2)
    with pytest.raises(FaceDiffError, match="steps"):
        model.choose_sampler(steps=-1)


def test_samples_of_few_steps_are_taken_further_from_the_mean(make_model: Make) -> None:
    made = {"steps": 10, "spacing": "log_snr", "first_noise": 200.0, "last_noise": 1.0}
    sampler = partial(registry.sampler.dpm_solver, **made)
    for space, wider in (("vertices", False), ("components", True)):
        model = make_model(diffusion_steps=1000, sampler=sampler, motion_space=getattr(registry.motion_space, space))
        assert model.hparams["sampler"]["init_args"]["spread"] == 1
        factors = []
        for steps in (2, 3, 5, 10, 20):
            model.choose_sampler(steps=steps)
            factors.append(model.sampler.spread)
        wanted = [1.31, 1.18, 1.07, 1.0, 1.0] if wider else [1.0] * 5
        assert factors == pytest.approx(wanted, abs=0.005)
    made_wide = partial(sampler, spread=1.9)
    model = make_model(diffusion_steps=1000, sampler=made_wide, motion_space=registry.motion_space.components)
    for steps, factor in ((2, 2.0), (10, 1.9)):  # at most twice
        model.choose_sampler(steps=steps)
        assert model.sampler.spread == pytest.approx(factor)
