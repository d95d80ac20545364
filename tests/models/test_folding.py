"""The products of the linear ends, and folded sampling against sampling on vertices: the same motion, distribution."""

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
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, folding
from facediff.models.dual_path.network import ConditionalDenoiser
from facediff.models.folding import Fold, FoldedSpace, VertexSpace, WeightCache, fold
from tests.fakes.tiny import Tiny


def ends(dim: int, coordinates: int, dtype: torch.dtype = torch.float64) -> tuple[nn.Linear, nn.Linear]:
    torch.manual_seed(0)
    return nn.Linear(coordinates, dim, dtype=dtype), nn.Linear(dim, coordinates, dtype=dtype)


@pytest.mark.parametrize(("dim", "coordinates"), [(6, 30), (6, 4), (5, 5), (1, 7)])
@pytest.mark.parametrize("chunk", [3, 1000])
def test_fold_products(dim: int, coordinates: int, chunk: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(folding, "CHUNK", chunk)
    first, last = ends(dim, coordinates)
    made = fold(first.weight.detach(), last.weight.detach(), last.bias.detach())
    e, u, b = first.weight.detach(), last.weight.detach(), last.bias.detach()
    torch.testing.assert_close(made.product, e @ u, rtol=0, atol=1e-14)
    torch.testing.assert_close(made.offset, e @ b, rtol=0, atol=1e-14)
    # With fewer coordinates than channels E Eᵀ is singular; square roots of rounding are 1e-8.
    torch.testing.assert_close(made.root @ made.root.T, e @ e.T, rtol=0, atol=1e-14)
    torch.testing.assert_close(made.root, made.root.T, rtol=0, atol=1e-14)
    assert torch.linalg.eigvalsh(made.root).min() > -1e-7


CHANGES: dict[str, Callable[[nn.Linear, nn.Linear], object]] = {
    "in place": lambda first, _: first.weight.detach().mul_(1.001),
    # As weight averages are swapped: no version counter sees it.
    "through data": lambda first, _: first.weight.data.copy_(first.weight.data.flip(0)),
    "last map through data": lambda _, last: last.weight.data.mul_(1 + 1e-6),
    "one number": lambda _, last: last.weight.data[3, 2].add_(0.01),
    "rows exchanged": lambda first, _: first.weight.data.copy_(first.weight.data.flip(1)),
    "bias": lambda _, last: last.bias.data[0].add_(1e-3),
    "state dict": lambda first, _: first.load_state_dict({k: 2 * v for k, v in first.state_dict().items()}),
    "type": lambda first, last: (first.float(), last.float()),
}


@pytest.mark.parametrize("change", CHANGES)
def test_weight_cache_sees_every_change(change: str) -> None:
    calls: list[int] = []
    first, last = ends(4, 12)
    cache: WeightCache[Fold] = WeightCache()

    def compute() -> Fold:
        calls.append(1)
        return fold(first.weight, last.weight, last.bias)

    for _ in range(3):
        cache.get([first.weight, last.weight, last.bias], "fold", compute)
    assert len(calls) == 1
    CHANGES[change](first, last)
    found = cache.get([first.weight, last.weight, last.bias], "fold", compute)
    assert len(calls) == 2
    expected = fold(first.weight.detach(), last.weight.detach(), last.bias.detach())
    for name in ("product", "offset", "root"):
        assert torch.equal(getattr(found, name), getattr(expected, name))


def test_weight_cache_filled_in_inference_mode_serves_outside_of_it() -> None:
    first, last = ends(4, 12)
    cache: WeightCache[Fold] = WeightCache()
    with torch.inference_mode():
        made = cache.get([first.weight], "fold", lambda: fold(first.weight, last.weight, last.bias))
    assert not made.product.is_inference()
    weight = torch.ones(4, 4, dtype=torch.float64, requires_grad=True)
    (made.product @ weight).sum().backward()


def test_fold_root_does_not_depend_on_the_signs_of_eigenvectors(monkeypatch: pytest.MonkeyPatch) -> None:
    first, last = ends(4, 12)
    maps = first.weight.detach(), last.weight.detach(), None
    once = fold(*maps).root
    real = torch.linalg.eigh

    def other(matrix: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, vectors = real(matrix)
        return values.flip(0), -vectors.flip(1)

    monkeypatch.setattr(torch.linalg, "eigh", other)
    torch.testing.assert_close(fold(*maps).root, once, rtol=0, atol=1e-14)


Make = Callable[..., DualPathDiffusion]

SAMPLERS: list[tuple[str, dict[str, Any]]] = [
    (name, {}) for name in registry.sampler.names() if registry.sampler.get(name).linear
]
SAMPLERS += [("ddim", {"steps": 7, "eta": 0.5}), ("ddim", {"steps": 1}), ("dpm_solver", {"steps": 18, "order": 3})]


@pytest.fixture
def ready(ready: Make) -> Make:
    """Models with biases that matter."""

    def make(**options: object) -> DualPathDiffusion:
        model = ready(**options)
        nn.init.normal_(model.network.embed.bias)
        nn.init.normal_(model.network.unembed.bias)
        return model

    return make


def cast(batch: Batch, dtype: torch.dtype) -> Batch:
    tensors = {name: value for name, value in vars(batch).items() if isinstance(value, Tensor)}
    return replace(batch, **{name: v.to(dtype) for name, v in tensors.items() if v.is_floating_point()})


def run(model: DualPathDiffusion, denoiser: ConditionalDenoiser, noise: Callable[[], Tensor]) -> Tensor:
    """The sampler with its noise given."""
    return denoiser.motion(model.sampler.run(denoiser.denoise, noise(), noise=lambda _: noise()))


def vertices(model: DualPathDiffusion, batch: Batch) -> ConditionalDenoiser:
    """On vertices, with everything computed again in every step."""
    return ConditionalDenoiser(model.network, model.conditions(batch))


def choose(model: DualPathDiffusion, batch: Batch) -> ConditionalDenoiser:
    """The denoiser that the model samples with."""
    made: list[ConditionalDenoiser] = []
    prepare = model.network.prepare_for_inference

    def watched(*given: Any, **named: Any) -> ConditionalDenoiser:  # noqa: ANN401
        made.append(prepare(*given, **named))
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model.network, "prepare_for_inference", watched)
        model.generate(batch)
    return made[0]


@pytest.mark.parametrize(("name", "options"), SAMPLERS)
@pytest.mark.parametrize(
    ("dtype", "tolerance"), [(torch.float64, 1e-10), pytest.param(torch.float32, 1e-4, marks=pytest.mark.slow)]
)
def test_folded_sampling_gives_the_same_motion_for_the_same_noise(
    ready: Make, batch: Batch, name: str, options: dict[str, Any], dtype: torch.dtype, tolerance: float
) -> None:
    model = ready(sampler=partial(registry.sampler.get(name), **options)).to(dtype)
    batch = cast(batch, dtype)
    network = model.network
    denoiser = choose(model, batch)
    assert isinstance(denoiser.space, FoldedSpace)
    shape = (*batch.motion.shape[:2], network.coordinates)

    def draws(seed: int) -> Callable[[], Tensor]:
        generator = torch.Generator().manual_seed(seed)
        return lambda: torch.randn(shape, generator=generator, dtype=dtype) * batch.mask[..., None]

    drawn = draws(1)
    with torch.no_grad():
        plain = run(model, vertices(model, batch), draws(1))
        folded = run(model, denoiser, lambda: drawn() @ network.embed.weight.T)
    assert plain[batch.mask].std() > 0.5
    torch.testing.assert_close(folded[batch.mask], plain[batch.mask], rtol=0, atol=tolerance)
    with torch.no_grad():
        other = run(model, vertices(model, batch), draws(2))
    assert (other - plain)[batch.mask].abs().max() > 1e-2  # the noise matters


def test_folded_sampling_gives_the_same_mean_and_covariance_for_new_noise(ready: Make, tiny: Tiny) -> None:
    """Over 3000 clips with noise of their own, in few directions of motion."""
    model = ready(sampler=partial(registry.sampler.ddim, steps=4, eta=1.0))
    with torch.no_grad():  # a network in which the noise is heard
        model.network.embed.weight.mul_(3)
    sample = tiny.dataset("val")[0]
    sample = replace(sample, motion=sample.motion[:3], audio=sample.audio[: 3 * 640])
    one = collate([sample])
    clips = 3000

    def motions(space: str, seed: int) -> Tensor:
        model.options.sampling_space = space
        tensors = {k: v for k, v in vars(one).items() if isinstance(v, Tensor)}
        many = {k: v.expand(clips, *v.shape[1:]) for k, v in tensors.items()}
        lists = {
            k: [f"{k}{i}" for i in range(clips)] for k, v in vars(one).items() if isinstance(v, list) and len(v) == 1
        }
        return model.generate(replace(one, **many, **lists), seed=seed).flatten(1) * model.scale

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


def test_sampling_space_is_vertices_without_linear_ends(ready: Make, batch: Batch) -> None:
    model, same = ready(), ready(sampling_space="vertices")
    for one in (model, same):
        torch.manual_seed(1)
        one.network.embed = nn.Sequential(nn.Linear(72, 16), nn.Tanh())
    assert isinstance(choose(model, batch).space, VertexSpace)
    assert torch.equal(model.generate(batch), same.generate(batch))


def test_sampler_that_is_wrongly_declared_linear_is_an_error(
    ready: Make, batch: Batch, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = ready()
    honest = model.sampler.run
    monkeypatch.setattr(model.sampler, "run", lambda *given, **named: 0.5 * honest(*given, **named))
    with pytest.raises(FaceDiffError, match="sampling_space=vertices"):
        model.generate(batch)


@pytest.mark.parametrize("sampler", [registry.sampler.ddim, registry.sampler.ddpm])
def test_generate_does_not_depend_on_the_other_clips_of_a_batch(ready: Make, tiny: Tiny, sampler: Any) -> None:  # noqa: ANN401
    model = ready(sampler=sampler)
    dataset = tiny.dataset("train")
    short, long = dataset[0], dataset[7]
    alone = model.generate(collate([short]), seed=5)[0]
    for samples, place in (([short, long], 0), ([long, dataset[3], short], 2)):
        together = model.generate(collate(samples), seed=5)[place, : len(short.motion)]
        torch.testing.assert_close(together * model.scale, alone * model.scale, rtol=0, atol=1e-4)


def test_folded_sampling_follows_changed_weights(ready: Make, batch: Batch) -> None:
    """Written as weight averaging writes them."""
    model, fresh = ready(), ready()
    model.generate(batch)
    for one in (model, fresh):
        torch.manual_seed(3)
        for parameter in one.network.parameters():
            parameter.data.copy_(parameter.data + 0.05 * torch.randn(parameter.shape))
    assert torch.equal(model.generate(batch), fresh.generate(batch))


def test_mixed_precision_motion_is_float32_and_near(ready: Make, batch: Batch) -> None:
    model = ready()
    exact = model.generate(batch)
    with torch.autocast("cpu", torch.bfloat16):
        mixed = model.generate(batch)
    assert mixed.dtype == torch.float32
    assert (mixed - exact)[batch.mask].square().mean() < 0.01 * exact[batch.mask].square().mean()
