"""Noise and network in principal components: exact for Gaussian motion, and the same distances as on the vertices."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lightning.pytorch import Trainer
from torch import Tensor

from facediff import registry
from facediff.data import Batch, collate
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from facediff.models.adaptation import with_extra_identities
from facediff.models.dual_path.recipe import log_snr_weights, noise_scale_for
from facediff.models.losses import preconditioned_losses
from facediff.models.motion_space import ComponentMotion, Preconditioning, TemporalPreconditioning
from facediff.models.samplers import DdpmSampler, DpmSolverSampler, NoiseProcess, Sampler
from tests.fakes.tiny import Tiny

Make = Callable[..., Any]
VARIANCES = torch.tensor([9.0, 1.0, 0.04])
ALL = torch.ones(1, 1000, dtype=torch.bool)


def motion(frames: int = 300, vertices: int = 6, rank: int = 5) -> Tensor:
    """Scaled motion of a few degrees of freedom with a mean, (1, frames, vertices, 3)."""
    random = torch.Generator().manual_seed(4)
    amounts = torch.randn(frames, rank, generator=random) * torch.tensor([3.0, 1.0, 0.5, 0.2, 0.1])[:rank]
    shapes = torch.linalg.qr(torch.randn(3 * vertices, rank, generator=random))[0].T
    return (amounts @ shapes + 0.3 * torch.randn(3 * vertices, generator=random)).view(1, frames, vertices, 3)


def components(x: Tensor, weights: Tensor | None = None, **options: Any) -> ComponentMotion:  # noqa: ANN401
    """A space that knows motion, by a singular value decomposition."""
    space = ComponentMotion(n_vertices=x.shape[2], dims=3, steps=1000, **options)
    flat = x[0].flatten(1)
    weights = torch.ones(flat.shape[1]) if weights is None else weights
    _, sizes, shapes = torch.linalg.svd((flat - flat.mean(0)) * weights, full_matrices=False)
    space.components.attach(flat.mean(0), sizes[:, None] * shapes / len(flat) ** 0.5, weights)
    space.fit(NoiseProcess().signal)
    return space


@pytest.mark.parametrize("whitening", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("weighted", [False, True])
def test_components_of_the_motions_own_rank_lose_nothing(whitening: float, weighted: bool) -> None:
    x = motion()
    weights = torch.linspace(0.5, 4, 18) if weighted else None
    space = components(x, weights, count=5, whitening=whitening)
    torch.testing.assert_close(space.decode(space.encode(x)), x, rtol=1e-4, atol=1e-4)
    assert space.encode(x).mean(1).abs().max() < 1e-4
    torch.testing.assert_close(space.encode(x).var(1, unbiased=False)[0], space.sizes.square(), rtol=1e-3, atol=0)


def test_components_that_the_motion_does_not_have_are_the_smallest_there_are() -> None:
    space = components(motion(), count=9)
    deviations = space.components.deviations
    torch.testing.assert_close(deviations[5:], 1e-4 * deviations[0].expand(4), rtol=1e-3, atol=0)
    assert (deviations[:5] > 0.05).all()


@pytest.mark.parametrize("whitening", [0.0, 0.3, 1.0])
def test_the_noise_sees_components_in_the_sizes_that_they_are_given(whitening: float) -> None:
    """d₁ · (d / d₁)^(1 − w), for the components of a space and for those that only measure the noise's scale."""
    space = components(motion(), count=5, whitening=whitening)
    own = space.components.deviations.double().numpy()
    expected = own[0] * (own / own[0]) ** (1 - whitening)
    np.testing.assert_allclose(space.sizes.numpy(), expected, rtol=1e-5)
    several = torch.tensor([16.0, 9.0, 0.25, 0.01])
    sizes = 4 * (several.sqrt().numpy() / 4) ** (1 - whitening)
    np.testing.assert_allclose(space.noised_variances(several).numpy(), sizes**2, rtol=1e-5)
    vertices = registry.motion_space.vertices(n_vertices=6, dims=3, steps=10)
    assert torch.equal(vertices.noised_variances(several), several)
    assert vertices.coordinates == 18
    assert not vertices.region_weights
    importance = (space.components.deviations / space.sizes).square().numpy()
    scales = space.preconditioning
    for step in (0, 500, 999):
        wanted = importance / (importance * scales.out[step].numpy() ** 2).sum()
        np.testing.assert_allclose(scales.loss[step].numpy(), wanted, rtol=1e-3)


@pytest.mark.parametrize("whitening", [0.0, 0.5, 1.0])
def test_losses_weigh_components_as_their_vertices(whitening: float) -> None:
    x = motion()
    other = x + 0.1 * (x - x.mean(1, keepdim=True)).flip(1)  # within the components
    space = components(x, count=5, whitening=whitening)
    squared = (space.encode(other) - space.encode(x)).square() * space.preconditioning.loss[500]
    error = (other - x).square().sum((2, 3))[0]
    ratio = squared.sum(-1)[0] / error
    assert float(ratio.std() / ratio.mean()) < 1e-3


def test_motion_that_never_changes_has_no_components() -> None:
    with pytest.raises(FaceDiffError, match="motion_space=components"):
        components(torch.zeros(1, 5, 6, 3), count=3)


def predicted(scales: Preconditioning, noisy: Tensor, features: Tensor, step: Tensor, mask: Tensor) -> Tensor:
    return scales.clean(scales.posterior_mean(noisy, step, mask), features, step, mask)


def gaussian(process: NoiseProcess) -> Preconditioning:
    made = Preconditioning(process.steps, len(VARIANCES))
    made.fit(process.signal, VARIANCES, torch.ones(3))
    return made


@pytest.mark.parametrize("step", [0, 300, 999])
def test_a_silent_network_gives_the_posterior_mean_of_gaussian_motion(step: int) -> None:
    process = NoiseProcess()
    kept, own = float(process.signal.double()[step]), VARIANCES.double().numpy()
    noisy = np.array([[[1.5, -0.7, 0.2]]])
    # Regression of x on y = √ᾱ x + √(1 − ᾱ) ε: cov(x, y) / var(y); what is left is var(x) − cov² / var(y).
    covariance, variance = np.sqrt(kept) * own, kept * own + 1 - kept
    scales = gaussian(process)
    found = predicted(scales, torch.from_numpy(noisy).float(), torch.zeros(1, 1, 3), torch.tensor([step]), ALL[:, :1])
    np.testing.assert_allclose(found.numpy(), covariance / variance * noisy, rtol=1e-4, atol=1e-7)
    np.testing.assert_allclose(scales.out[step].numpy() ** 2, own - covariance**2 / variance, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(scales.into[step].numpy() ** 2 * variance, 1, rtol=1e-4)
    assert float((scales.loss[step] * scales.out[step] ** 2).sum()) == pytest.approx(1, rel=1e-4)


@pytest.mark.parametrize("over_windows", [False, True])
def test_what_noise_hides_is_counted_as_the_losses_count(over_windows: bool) -> None:
    process, counted = NoiseProcess(), torch.tensor([2.0, 1.0, 5.0])
    if over_windows:
        scales: Preconditioning = TemporalPreconditioning(process.steps, len(VARIANCES), 1)
        assert isinstance(scales, TemporalPreconditioning)
        scales.fit_covariance(process.signal, VARIANCES.view(-1, 1, 1), counted)
    else:
        scales = Preconditioning(process.steps, len(VARIANCES))
        scales.fit(process.signal, VARIANCES, counted)
    kept, own = process.signal.double().numpy()[:, None], VARIANCES.double().numpy()
    left = (counted.double().numpy() * own * (1 - kept) / (kept * own + 1 - kept)).sum(1)
    np.testing.assert_allclose(scales.hidden().numpy(), left / left[-1], rtol=1e-4)


def test_training_steps_follow_from_what_noise_hides(make_model: Make, make_trainer: Make, tiny: Tiny) -> None:
    model = make_model(motion_space=partial(ComponentMotion, count=4), timestep_sampling="log_snr")
    make_trainer(max_steps=1).fit(model, tiny)
    drawn: list[Tensor] = []
    model.process.draw_steps = lambda count, device, *_, weights, **__: (  # type: ignore[method-assign]
        drawn.append(weights) or torch.zeros(count, dtype=torch.long)
    )
    model.losses(next(iter(tiny.val_dataloader())))
    assert model.motion_space.preconditioning is not None
    expected = log_snr_weights(model.process, model.motion_space.preconditioning.hidden())
    torch.testing.assert_close(drawn[0], expected)


def test_training_steps_do_not_follow_what_a_validation_sees(make_model: Make, tiny: Tiny, batch: Batch) -> None:
    """Weight averages, swapped in there, bring tables of their own."""
    model = make_model(motion_space=partial(ComponentMotion, count=4), timestep_sampling="log_snr")
    model.adopt(tiny.assets().with_motion_scale(1.0))
    scales = model.motion_space.preconditioning
    drawn: list[Tensor] = []
    model.process.draw_steps = lambda *_, weights, **__: drawn.append(weights)
    model.losses_at = lambda *_: {}
    for training, size in ((False, 9.0), (True, 0.1), (False, 9.0), (True, 0.1), (True, 0.1)):
        scales.fit(model.process.signal, torch.full((4,), size), torch.ones(4))
        model.train(training).losses(batch)
        torch.testing.assert_close(drawn[-1], log_snr_weights(model.process, scales.hidden()))
    assert not torch.allclose(drawn[0], drawn[1])


def test_steps_by_what_noise_hides_need_a_space_that_knows_it(make_model: Make) -> None:
    with pytest.raises(FaceDiffError, match=r"model\.timestep_sampling log_snr: .*motion_space=components"):
        make_model(timestep_sampling="log_snr")


SLOWNESS = torch.tensor([3.0, 1.0, 6.0])


def over_time(lags: Tensor) -> Tensor:
    """Covariance (3, …) of smooth stationary motion at some lags: bells over a little that is white."""
    bells = torch.exp(-((lags.double() / SLOWNESS.double().view(-1, *[1] * lags.dim())) ** 2) / 2)
    return VARIANCES.double().view(-1, *[1] * lags.dim()) * (0.97 * bells + 0.03 * (lags == 0))


def smooth(process: NoiseProcess, frames: int) -> TemporalPreconditioning:
    scales = TemporalPreconditioning(process.steps, len(VARIANCES), frames)
    places = torch.arange(frames)
    scales.fit_covariance(process.signal, over_time(places[:, None] - places), torch.ones(3))
    return scales


def test_movements_over_a_window_add_up_to_what_noise_lets_show() -> None:
    """Σ d² cᵀ (C + I / (b s)²)⁻¹ c, with the column c of the middle frame; as a frame of each component is smoothed."""
    space = components(motion(), count=3, whitening=0.3, prior_frames=5)
    places = torch.arange(5)
    covariance = over_time(places[:, None] - places) / VARIANCES.double().view(-1, 1, 1)
    noised, shares = (x.numpy() for x in space.modes(covariance))
    own = space.components.deviations.double().numpy()
    sizes = own[0] * (own / own[0]) ** 0.7
    for scale in (0.03, 0.5, 8.0):
        shown = [
            d**2 * (c[2] @ np.linalg.solve(c + np.eye(5) / (scale * size) ** 2, c[2]))
            for c, d, size in zip(covariance.numpy(), own, sizes, strict=True)
        ]
        gains = scale**2 * noised / (scale**2 * noised + 1)
        assert float(shares @ gains) == pytest.approx(sum(shown), rel=1e-6)


def test_movements_that_a_window_does_not_have_are_the_smallest_there_are() -> None:
    """One that stands still within it has a single movement; the others' deviations are 1e-4 of its own."""
    scales = TemporalPreconditioning(10, 2, 5)
    covariance = torch.tensor([9.0, 0.04]).view(2, 1, 1) * torch.ones(5, 5)
    scales.fit_covariance(NoiseProcess(10).signal, covariance, torch.ones(2))
    deviations = scales.variances.sqrt() / torch.tensor([[3.0], [0.2]])
    torch.testing.assert_close(deviations, 5**0.5 * torch.tensor([1e-4, 1e-4, 1e-4, 1e-4, 1.0]).expand(2, -1))


@pytest.mark.parametrize("step", [0, 300, 999])
def test_a_silent_network_smooths_by_the_frames_of_its_window(step: int) -> None:
    """To what the next test computes; features add what the posterior leaves open; padding changes nothing."""
    process, random = NoiseProcess(), np.random.default_rng(1)
    scales, kept = smooth(process, 7), float(process.signal.double()[step])
    noisy = torch.from_numpy(random.standard_normal((2, 15, 3))).float()
    mask = torch.arange(15) < torch.tensor([[15], [9]])
    steps, silence = torch.tensor([step, step]), torch.zeros(2, 15, 3)
    clean = predicted(scales, noisy, silence, steps, mask)
    torch.testing.assert_close(clean, scales.posterior_mean(noisy, steps, mask))
    features = torch.randn(2, 15, 3)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(predicted(scales, noisy, silence, steps, mask), clean), "motion is not rounded"
    alone = predicted(scales, noisy[1:, :9], features[1:, :9], steps[1:], mask[1:, :9])
    torch.testing.assert_close(predicted(scales, noisy, features, steps, mask)[1:, :9], alone)
    places = torch.arange(7)
    covariance = over_time(places[:, None] - places).numpy()
    # White features leave what the posterior leaves open.
    many = predicted(
        scales, torch.zeros(1, 100_000, 3), torch.randn(1, 100_000, 3), steps[:1], torch.ones(1, 100_000) > 0
    )
    for k, own in enumerate(covariance):
        total = kept * own + (1 - kept) * np.eye(7)
        left = own[3, 3] - kept * own[3] @ np.linalg.solve(total, own[3])
        assert float(many[0, :, k].var()) == pytest.approx(left, rel=0.03, abs=1e-6)
    assert predicted(scales, noisy[:, :3], silence[:, :3], steps, mask[:, :3]).isfinite().all()


@pytest.mark.parametrize("lengths", [(15, 9), (7, 8), (5, 1), (3, 12)])
def test_every_frame_is_smoothed_within_its_own_clip(lengths: tuple[int, int]) -> None:
    """By the dense formula G = √ᾱ C (ᾱ C + (1 − ᾱ) I)⁻¹ of the outermost window that holds the frame.

    What is shorter than a window goes on at the mean; whatever padding holds, it enters none.
    """
    process, width, count = NoiseProcess(), 7, max(lengths) + 2
    scales, kept = smooth(process, width), float(process.signal.double()[400])
    noisy = torch.randn(2, count, 3, generator=torch.Generator().manual_seed(2))
    mask = torch.arange(count) < torch.tensor(lengths)[:, None]
    made = scales.posterior_mean(noisy, torch.tensor([400, 400]), mask)
    places = torch.arange(width)
    covariance = over_time(places[:, None] - places).double()
    gains = kept**0.5 * covariance @ torch.linalg.inv(kept * covariance + (1 - kept) * torch.eye(width))
    for clip, length in enumerate(lengths):
        values = torch.cat([noisy[clip, :length].double(), torch.zeros(width, 3)])
        for frame in range(length):
            first = min(max(frame - width // 2, 0), max(length - width, 0))
            expected = torch.einsum("cw,wc->c", gains[:, frame - first], values[first : first + width])
            torch.testing.assert_close(made[clip, frame].double(), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "sampler", [lambda p: DdpmSampler(process=p, steps=100), lambda p: DpmSolverSampler(process=p, steps=50)]
)
def test_sampling_with_a_silent_network_gives_motion_of_the_covariance_over_time(
    sampler: Callable[[NoiseProcess], Sampler],
) -> None:
    process = NoiseProcess()
    scales, random = smooth(process, 25), torch.Generator().manual_seed(0)

    def noise(like: Tensor) -> Tensor:
        return torch.randn(like.shape, generator=random)

    def denoise(noisy: Tensor, step: int) -> Tensor:
        mask = ALL[:, : noisy.shape[1]].expand(len(noisy), -1)
        return predicted(scales, noisy, torch.zeros_like(noisy), torch.full((len(noisy),), step), mask)

    sample = sampler(process).run(denoise, noise(torch.empty(120, 60, 3)), noise=noise)
    # The network sees both in unit variance.
    mask, steps = ALL[:, :60].expand(120, -1), torch.full((120,), 400)
    noisy = process.add_noise(sample, torch.randn(sample.shape, generator=random), steps)
    seen = scales.inputs(noisy, scales.posterior_mean(noisy, steps, mask), steps, mask)[:, 12:-12]
    assert seen.shape[2] == 3 * 8
    assert ((seen.square().mean((0, 1)) - 1).abs() < 0.15).all()
    for place, offset in enumerate((-4, -2, -1, 0, 1, 2, 4), 1):
        around = seen[:, 4 + offset : 32 + offset, 12:15]  # other frames' own smoothed motion
        torch.testing.assert_close(seen[:, 4:32, 3 * place : 3 * place + 3], around)
    for lag in (0, 1, 2, 4, 8):
        expected = over_time(torch.tensor(lag)).float()
        found = (sample[:, lag:] * sample[:, : 60 - lag]).mean((0, 1))
        assert ((found - expected).abs() < 0.1 * VARIANCES).all(), (lag, found, expected)
    ends = sample[:, [0, -1]].square().mean((0, 1))  # as lively as the middle
    assert ((ends / VARIANCES - 1).abs() < 0.25).all()


@pytest.mark.parametrize("scale", [0.1, 0.5, 3.0])
def test_noise_scale_is_motion_of_another_size(scale: float) -> None:
    plain, scaled = NoiseProcess(), NoiseProcess(scale=scale)
    clean, noise = torch.randn(4, 7), torch.randn(4, 7)
    steps = torch.tensor([0, 400, 700, 999])
    kept = plain.signal[steps, None]
    total = (scale**2 * kept + 1 - kept).sqrt()
    torch.testing.assert_close(
        scaled.add_noise(clean, noise, steps),
        plain.add_noise(scale * clean, noise, steps) / total,
        rtol=1e-4,
        atol=1e-5,
    )
    torch.testing.assert_close(
        torch.cumprod(1 - scaled.variances.double(), 0).float(), scaled.signal, rtol=2e-2, atol=0
    )
    share = scale**2 * plain.signal.double().numpy()
    share = share / (share + 1 - plain.signal.double().numpy())
    np.testing.assert_allclose(scaled.signal.numpy(), share, rtol=1e-6)
    np.testing.assert_allclose(scaled.variances.numpy(), 1 - share / np.concatenate([[1.0], share[:-1]]), rtol=1e-5)
    assert (scaled.variances > 0).all()
    assert (scaled.steps, scaled.schedule, scaled.scale) == (1000, "squaredcos_cap_v2", scale)


def test_noise_far_smaller_than_motion_is_never_none() -> None:
    """Motion in metres is so much smaller than 1 that the noise scale which hides half of it is large."""
    process = NoiseProcess(scale=300.0)
    for sampler in (DdpmSampler(process=process), DpmSolverSampler(process=process, spacing="log_snr")):
        assert sampler.run(lambda noisy, step: 0.5 * noisy, torch.randn(1, 2, 3)).isfinite().all()
    tables = Preconditioning(1000, 3)
    tables.fit(process.signal, VARIANCES, torch.ones(3))
    assert tables.loss.isfinite().all()


def test_the_noise_scale_hides_half_of_the_variance() -> None:
    variances = torch.tensor([900.0, 30.0, 2.0, 0.1])
    scale = noise_scale_for(variances)
    shown = scale**2 * variances / (scale**2 * variances + 1)
    assert float((variances * shown).sum() / variances.sum()) == pytest.approx(0.5, abs=1e-5)
    assert noise_scale_for(4 * variances) == pytest.approx(scale / 2)
    # White motion of which the components count differently.
    assert noise_scale_for(torch.ones(4), variances) == pytest.approx(1.0)


def test_preconditioned_losses_are_their_formulas_and_padding_never_counts() -> None:
    random = np.random.default_rng(0)
    gaps, weight = [random.standard_normal((frames, 3)) for frames in (7, 4)], random.uniform(0.5, 2, (2, 3))
    expected = {}
    for order, name in enumerate(("reconstruction", "velocity", "acceleration")):
        terms = [(np.diff(gap, n=order, axis=0) ** 2 * w).sum(1) for gap, w in zip(gaps, weight, strict=True)]
        expected[name] = np.concatenate(terms).mean()
    padded = torch.full((2, 9, 3), 1e3)
    for row, gap in zip(padded, gaps, strict=True):
        row[: len(gap)] = torch.from_numpy(gap)
    mask = torch.arange(9) < torch.tensor([[7], [4]])
    weights = {"reconstruction": 1.0, "velocity": 2.0, "acceleration": 0.5, "face": 9.0}
    found = preconditioned_losses(padded, torch.zeros_like(padded), mask, torch.from_numpy(weight).float(), weights)
    for name, value in expected.items():
        assert float(found[name]) == pytest.approx(value, rel=1e-5)
    assert float(found["loss"]) == pytest.approx(
        sum(weights[name] * value for name, value in expected.items()), rel=1e-5
    )


SPACE = partial(registry.motion_space.components, count=6)


@pytest.fixture
def trained(make_model: Make, make_trainer: Callable[..., Trainer], tiny: Tiny) -> DualPathDiffusion:
    model: DualPathDiffusion = make_model(motion_space=SPACE, noise_scale="auto", learning_rate=1e-2)
    make_trainer(max_epochs=2).fit(model, datamodule=tiny)
    return model.eval()


def test_training_measures_components_and_noise_scale(trained: DualPathDiffusion, tiny: Tiny) -> None:
    space = trained.motion_space
    assert isinstance(space, ComponentMotion)
    mean, shapes = tiny.principal_motion(6)
    torch.testing.assert_close(space.components.mean, mean * trained.scale)
    torch.testing.assert_close(space.components.deviations[0], shapes[0].norm() * trained.scale)
    variances = space.sizes.square() * trained.process.scale**2
    share = space.components.deviations.square()
    share = share / share.sum()
    assert float((share * variances / (variances + 1)).sum()) == pytest.approx(0.5, abs=0.02)
    assert trained.sampler.process is trained.process
    torch.testing.assert_close(space.preconditioning.skip[0, :2], torch.ones(2), rtol=0.2, atol=0)


def test_a_further_identity_keeps_the_noise_scale(trained: DualPathDiffusion) -> None:
    grown = with_extra_identities(trained, ["C", *trained.identities])
    assert isinstance(grown, DualPathDiffusion)
    assert grown.process.scale == trained.process.scale != 1
    assert grown.sampler.signal == trained.sampler.signal


def test_a_validation_before_training_leaves_the_measuring_to_it(
    make_model: Make, make_trainer: Callable[..., Trainer], tiny: Tiny
) -> None:
    model = make_model(motion_space=SPACE, motion_scale="none")
    make_trainer(limit_val_batches=1).validate(model, tiny, verbose=False)
    make_trainer(max_steps=1, limit_val_batches=0).fit(model, datamodule=tiny)
    torch.testing.assert_close(model.motion_space.components.basis[0].norm(), torch.tensor(1.0))


def test_training_measures_the_covariance_over_time(make_model: Make, make_trainer: Make, tiny: Tiny) -> None:
    model = make_model(motion_space=partial(SPACE, prior_frames=5), noise_scale="auto")
    make_trainer(max_epochs=1).fit(model, datamodule=tiny)
    space = model.motion_space
    assert isinstance(space.preconditioning, TemporalPreconditioning)
    windows = []
    for clip in tiny.clips("train"):
        coordinates = space.encode(tiny.corpus.read_motion(clip)[None] * model.scale)[0].double()
        first = max(0, (len(coordinates) - 20) // 2)
        windows.append(coordinates[first : first + 20].unfold(0, 5, 1).numpy())
    stacked = np.concatenate(windows)
    expected = np.einsum("nki,nkj->kij", stacked, stacked) / len(stacked)
    expected = (expected + expected[:, ::-1, ::-1]) / 2
    scales = space.preconditioning
    measured = scales.vectors * scales.variances[:, None] @ scales.vectors.transpose(1, 2)
    np.testing.assert_allclose(measured[:3].detach(), expected[:3], rtol=1e-3, atol=1e-3 * float(expected[:3].max()))
    # Half of a frame's variance shows where the schedule has as much signal as noise, given the frames around it.
    measured = measured.detach().double().numpy() * model.process.scale**2
    shown = [own[2] @ np.linalg.solve(own + np.eye(5), own[:, 2]) for own in measured]
    weight = (space.components.deviations / space.sizes).square().double().numpy()
    total = measured[:, 2, 2] @ weight
    assert float(np.array(shown) @ weight / total) == pytest.approx(0.5, abs=0.02)
    with pytest.raises(FaceDiffError, match="prior_frames"):
        ComponentMotion(n_vertices=6, dims=3, steps=10, prior_frames=4)
    with pytest.raises(FaceDiffError, match="prior_frames"):
        tiny.covariance_over_time(lambda x: x.flatten(2), 9999)


def test_a_checkpoint_animates_as_the_model_that_wrote_it(
    trained: DualPathDiffusion, make_trainer: Callable[..., Trainer], tiny: Tiny, tmp_path: Path
) -> None:
    trainer = make_trainer()
    trainer.strategy.connect(trained)
    trainer.save_checkpoint(tmp_path / "model.ckpt")
    loaded = load_model(tmp_path / "model.ckpt")
    assert isinstance(loaded, DualPathDiffusion)
    assert loaded.process.scale == trained.process.scale != 1
    speech = torch.randn(16_000, generator=torch.Generator().manual_seed(0))
    identity = trained.identities[0]
    first, second = (model.animate(speech, identity=identity, seed=3).vertices for model in (trained, loaded))
    torch.testing.assert_close(first, second)
    assert not torch.equal(first, trained.animate(speech, identity=identity, seed=4).vertices)


@pytest.mark.parametrize("scale", [0.0, float("nan"), "0.1", [1.0], torch.ones(2)])
def test_a_wild_noise_scale_in_a_checkpoint_is_refused(scale: object, make_model: Make, tiny: Tiny) -> None:
    model = make_model(noise_scale="auto")
    with pytest.raises(FaceDiffError, match="noise_scale"):
        model.on_load_checkpoint({"facediff_assets": tiny.assets().state(), "facediff_noise_scale": scale})


@pytest.mark.parametrize(
    ("scale", "space", "wanted"), [("auto", None, 64), (1.0, None, None), (1.0, 9, 9), ("auto", 70, 70)]
)
def test_the_noise_scale_is_measured_by_the_64_largest_components(
    make_model: Make, tiny: Tiny, scale: object, space: int | None, wanted: int | None
) -> None:
    """Of a corpus that has more; whatever a motion space may need itself."""
    options = {} if space is None else {"motion_space": partial(registry.motion_space.components, count=space)}
    model: DualPathDiffusion = make_model(noise_scale=scale, **options)
    model.adopt(tiny.assets().with_motion_scale(2.0))
    asked: list[int] = []
    basis = torch.linalg.qr(torch.randn(72, 72, generator=torch.Generator().manual_seed(0)))[0]
    sizes = torch.linspace(1.0, 0.1, 72)

    class Motion:
        def principal_motion(self, count: int, weights: Tensor) -> tuple[Tensor, Tensor]:
            asked.append(count)
            return torch.zeros(72), (sizes[:, None] * basis)[:count]

    shapes = model.measure(Motion())
    assert asked == ([] if wanted is None else [wanted])
    assert (shapes is None) == (wanted is None)
    if scale == "auto":
        variances = (2 * sizes[:64]).square()
        seen = model.motion_space.noised_variances(variances)
        assert model.process.scale == pytest.approx(noise_scale_for(seen, variances), rel=1e-4)


def test_lips_and_upper_face_count_by_their_own_weights(make_model: Make, tiny: Tiny) -> None:
    model: DualPathDiffusion = make_model(motion_space=partial(SPACE, upper_face_weight=3.0, lips_weight=0.5))
    model.adopt(tiny.assets().with_motion_scale(1.0))
    weights, regions = model.motion_weights(tiny), model.assets.regions
    assert weights.shape == (model.n_vertices, 3)
    assert (weights[regions["upper_face"]] == 3).all()
    assert (weights[regions["lips"]] == 0.5).all()
    plain: DualPathDiffusion = make_model()
    plain.adopt(tiny.assets().with_motion_scale(1.0))
    assert (plain.motion_weights(tiny) == 1).all()


def test_eyelids_count_by_the_pairs_of_the_corpus(
    make_model: Make, tiny: Tiny, monkeypatch: pytest.MonkeyPatch
) -> None:
    model: DualPathDiffusion = make_model(motion_space=partial(SPACE, upper_face_weight=3.0, eyelids_weight=9.0))
    model.adopt(tiny.assets().with_motion_scale(1.0))
    upper = model.assets.regions["upper_face"]
    monkeypatch.setattr(tiny, "eyelid_pairs", lambda: None)  # VOCASET and BIWI list none
    assert (model.motion_weights(tiny)[upper] == 3).all()
    lids = upper[:4].view(2, 2)
    monkeypatch.setattr(tiny, "eyelid_pairs", lambda: lids)
    weights = model.motion_weights(tiny)
    assert (weights[lids.flatten()] == 9).all()
    assert int((weights == 9).sum()) == 12
    assert (weights[upper[4:]] == 3).all()


def test_training_on_components_is_training_on_vertices(make_model: Make, make_trainer: Make, tiny: Tiny) -> None:
    """Losses of a batch that was read as components are those of the same clips, windows and references."""
    made = partial(registry.mesh_encoder.components, count=4)
    model = make_model(motion_space=SPACE, mesh_encoder=made)
    shapes = []
    own = model.losses_at
    model.losses_at = lambda batch, *more: (shapes.append(batch.motion.dim()), own(batch, *more))[1]
    make_trainer(max_steps=1, limit_val_batches=1, num_sanity_val_steps=0).fit(model, datamodule=tiny)
    assert shapes[0] == 3  # in training
    projection = tiny.projection.project
    batches = []
    for chosen in (None, projection):
        tiny.projection.choose(chosen)
        data = tiny.dataset("train", training=True)
        torch.manual_seed(3)
        batches.append(collate([data[index] for index in (0, 2, 5)]))
    vertices, numbers = batches
    assert numbers.motion.shape == (*vertices.motion.shape[:2], 6)
    assert numbers.reference.shape == (*vertices.reference.shape[:2], 6)
    assert vertices.names == numbers.names
    assert vertices.reference_names == numbers.reference_names
    step, noise = torch.tensor([900, 500, 20]) * model.process.steps // 1000, torch.randn(*numbers.motion.shape)
    found, expected = (model.eval().losses_at(batch, step, noise.clone()) for batch in (numbers, vertices))
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"motion_space": SPACE},  # its reference is encoded on the vertices
        {
            "motion_space": SPACE,
            "mesh_encoder": partial(registry.mesh_encoder.components, count=4),
            "invented_speakers": 0.5,
        },
    ],
)
def test_motion_is_read_as_vertices_where_a_part_needs_them(
    options: dict[str, object], make_model: Make, make_trainer: Make, tiny: Tiny
) -> None:
    tiny.projection.choose(lambda motion: motion[:, 0])  # of a model before
    make_trainer(max_steps=1).fit(make_model(**options), datamodule=tiny)
    assert tiny.projection.project is None
