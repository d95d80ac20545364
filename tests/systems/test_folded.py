"""Folded sampling against sampling on vertices: the same motion for the same noise, else the same distribution."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, collate
from facediff.diffusion import folding
from facediff.errors import FaceDiffError
from facediff.systems import DualPathDiffusion
from facediff.systems.dual_path.spaces import FoldedSpace, Space, VertexSpace, choose_space
from tests.fakes.tiny import Tiny

Make = Callable[..., DualPathDiffusion]

SAMPLERS: list[tuple[str, dict[str, Any]]] = [
    (name, {}) for name in registry.sampler.names() if registry.sampler.get(name).linear
]
SAMPLERS += [("ddim", {"steps": 7, "eta": 0.5}), ("ddim", {"steps": 1}), ("dpm_solver", {"steps": 18, "order": 3})]


@pytest.fixture
def ready(make_system: Make, tiny: Tiny) -> Make:
    """Systems that know the miniature corpus, with biases that matter."""

    def make(**options: object) -> DualPathDiffusion:
        system = make_system(**options)
        system.adopt(tiny.assets().with_motion_scale(tiny.motion_scale()))
        nn.init.normal_(system.network.embed.bias)
        nn.init.normal_(system.network.unembed.bias)
        return system.eval()

    return make


@pytest.fixture
def batch(tiny: Tiny) -> Batch:
    """Two clips, the first padded."""
    dataset = tiny.dataset("train")
    return collate([dataset[0], dataset[7]])


def cast(batch: Batch, dtype: torch.dtype) -> Batch:
    tensors = {name: value for name, value in vars(batch).items() if isinstance(value, Tensor)}
    return replace(batch, **{name: v.to(dtype) for name, v in tensors.items() if v.is_floating_point()})


def run(system: DualPathDiffusion, batch: Batch, space: Space, noise: Callable[[], Tensor]) -> Tensor:
    """The sampler in a space, with its noise given; on vertices, all is computed anew in every step."""
    conditions = system._conditions(batch)
    if isinstance(space, FoldedSpace):
        conditions = system.network.prepared(conditions, system.process.steps)

    def denoise(state: Tensor, step: int) -> Tensor:
        return space.predict(state, torch.full((len(state),), step), conditions)

    return space.motion(system.sampler.run(denoise, noise(), noise=lambda _: noise()))


@pytest.mark.parametrize(("name", "options"), SAMPLERS)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-10), (torch.float32, 1e-4)])
def test_the_same_noise_gives_the_same_motion(
    ready: Make, batch: Batch, name: str, options: dict[str, Any], dtype: torch.dtype, tolerance: float
) -> None:
    system = ready(sampler=partial(registry.sampler.get(name), **options)).to(dtype)
    batch = cast(batch, dtype)
    network = system.network
    space = choose_space(network, "folded", system.sampler, system._fold_cache)
    assert isinstance(space, FoldedSpace)
    shape = (*batch.motion.shape[:2], network.coordinates)

    def draws(seed: int) -> Callable[[], Tensor]:
        generator = torch.Generator().manual_seed(seed)
        return lambda: torch.randn(shape, generator=generator, dtype=dtype) * batch.mask[..., None]

    drawn = draws(1)
    with torch.no_grad():
        plain = run(system, batch, VertexSpace(network, network.coordinates), draws(1))
        folded = run(system, batch, space, lambda: drawn() @ network.embed.weight.T)
    assert plain[batch.mask].std() > 0.5
    torch.testing.assert_close(folded[batch.mask], plain[batch.mask], rtol=0, atol=tolerance)
    with torch.no_grad():
        other = run(system, batch, VertexSpace(network, network.coordinates), draws(2))
    assert (other - plain)[batch.mask].abs().max() > 1e-2  # the noise matters


def test_fresh_noise_gives_the_same_mean_and_covariance(ready: Make, tiny: Tiny) -> None:
    """Over 3000 clips with noise of their own, in few directions of motion."""
    system = ready(sampler=partial(registry.sampler.ddim, steps=4, eta=1.0))
    with torch.no_grad():  # a network in which the noise is heard
        system.network.embed.weight.mul_(3)
    sample = tiny.dataset("val")[0]
    sample = replace(sample, motion=sample.motion[:3], audio=sample.audio[: 3 * 640])
    one = collate([sample])
    clips = 3000

    def motions(space: str, seed: int) -> Tensor:
        system.sampling_space = space
        tensors = {k: v for k, v in vars(one).items() if isinstance(v, Tensor)}
        many = {k: v.expand(clips, *v.shape[1:]) for k, v in tensors.items()}
        lists = {
            k: [f"{k}{i}" for i in range(clips)] for k, v in vars(one).items() if isinstance(v, list) and len(v) == 1
        }
        return system.generate(replace(one, **many, **lists), seed=seed).flatten(1) * system.scale

    plain, folded = motions("vertices", 1), motions("folded", 2)
    directions = torch.randn(plain.shape[1], 6, generator=torch.Generator().manual_seed(0))
    mean = plain.mean(0)
    a, b = (plain - mean) @ directions, (folded - mean) @ directions
    deviation = a.std(0)
    assert deviation.min() > 0.05
    error = deviation * (2 / clips) ** 0.5
    assert ((a.mean(0) - b.mean(0)).abs() / error).max() < 4.5
    products = [(x / deviation)[:, :, None] * (x / deviation)[:, None, :] for x in (a, b)]
    first, second = (product.mean(0) for product in products)
    error = ((products[0].var(0) + products[1].var(0)) / clips).sqrt()
    assert ((first - second).abs() / error).max() < 4.5


def test_folded_is_the_default_and_vertices_an_option(ready: Make, batch: Batch) -> None:
    folded, plain = ready(), ready(sampling_space="vertices")
    assert folded.hparams["sampling_space"] == "folded"
    assert isinstance(choose(folded), FoldedSpace)
    assert isinstance(choose(plain), VertexSpace)
    assert plain.generate(batch).shape == folded.generate(batch).shape == batch.motion.shape


def choose(system: DualPathDiffusion) -> Space:
    return choose_space(system.network, system.sampling_space, system.sampler, system._fold_cache)


def test_ends_that_are_not_linear_sample_on_vertices(ready: Make, batch: Batch) -> None:
    system, same = ready(), ready(sampling_space="vertices")
    for one in (system, same):
        torch.manual_seed(1)
        one.network.embed = nn.Sequential(nn.Linear(72, 16), nn.Tanh())
    assert isinstance(choose(system), VertexSpace)
    assert torch.equal(system.generate(batch), same.generate(batch))


def test_ends_without_biases_fold(ready: Make, batch: Batch) -> None:
    system = ready().double()
    system.network.embed.bias = system.network.unembed.bias = None
    network, batch = system.network, cast(batch, torch.float64)
    start = torch.randn(*batch.motion.shape[:2], 72, dtype=torch.float64)
    with torch.no_grad():
        plain = run(system, batch, VertexSpace(network, 72), lambda: start)
        folded = run(system, batch, choose(system), lambda: start @ network.embed.weight.T)
    torch.testing.assert_close(folded, plain, rtol=0, atol=1e-10)


def test_a_sampler_that_is_not_linear_runs_on_vertices(
    ready: Make, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = ready()
    monkeypatch.setattr(type(system.sampler), "linear", False)
    assert isinstance(choose(system), VertexSpace)
    assert system.generate(batch).shape == batch.motion.shape


def test_a_sampler_that_only_claims_to_end_at_its_prediction_is_named(
    ready: Make, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = ready()
    honest = system.sampler.run
    monkeypatch.setattr(system.sampler, "run", lambda *given, **named: 0.5 * honest(*given, **named))
    with pytest.raises(FaceDiffError, match="sampling_space=vertices"):
        system.generate(batch)


@pytest.mark.parametrize("sampler", [registry.sampler.ddim, registry.sampler.ddpm])
def test_a_clip_does_not_depend_on_the_clips_beside_it(ready: Make, tiny: Tiny, sampler: Any) -> None:  # noqa: ANN401
    system = ready(sampler=sampler)
    dataset = tiny.dataset("train")
    short, long = dataset[0], dataset[7]
    alone = system.generate(collate([short]), seed=5)[0]
    for samples, place in (([short, long], 0), ([long, dataset[3], short], 2)):
        together = system.generate(collate(samples), seed=5)[place, : len(short.motion)]
        torch.testing.assert_close(together * system.scale, alone * system.scale, rtol=0, atol=1e-4)


def test_noise_is_independent_over_frames_and_zero_on_padding(ready: Make, batch: Batch) -> None:
    space = choose(ready())
    unit = torch.randn(*batch.motion.shape[:2], space.width) * batch.mask[..., None]
    noise = space.noise(unit)
    assert not noise[~batch.mask].any()
    other = unit.clone()
    other[:, 3] = 0
    assert torch.equal((space.noise(other) != noise).any(-1).any(0).nonzero()[:, 0], torch.tensor([3]))


def test_changed_weights_are_seen(ready: Make, batch: Batch) -> None:
    """Written as weight averaging writes them."""
    system, fresh = ready(), ready()
    system.generate(batch)
    for one in (system, fresh):
        torch.manual_seed(3)
        for parameter in one.network.parameters():
            parameter.data.copy_(parameter.data + 0.05 * torch.randn(parameter.shape))
    assert torch.equal(system.generate(batch), fresh.generate(batch))


def test_weights_are_multiplied_once(ready: Make, batch: Batch, monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    real = folding.fold
    monkeypatch.setattr(folding, "fold", lambda *maps: (calls.append(1), real(*maps))[1])
    system = ready()
    for seed in range(3):
        system.generate(batch, seed=seed)
    assert len(calls) == 1


def test_a_frame_costs_nothing_per_vertex_until_the_end(ready: Make, batch: Batch) -> None:
    system = ready(sampler=partial(registry.sampler.ddpm, steps=9))
    calls = {"embed": 0, "unembed": 0}
    for name in calls:

        def count(*_: object, name: str = name) -> None:
            calls[name] += 1

        getattr(system.network, name).register_forward_hook(count)
    system.generate(batch)
    assert calls == {"embed": 0, "unembed": 1}


def test_in_mixed_precision_motion_is_float32_and_near(ready: Make, batch: Batch) -> None:
    system = ready()
    exact = system.generate(batch)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = system.generate(batch)
    assert mixed.dtype == torch.float32
    assert (mixed - exact)[batch.mask].square().mean() < 0.01 * exact[batch.mask].square().mean()
