"""The noise process against equation 1, every sampler against the truth that it must recover and its own formula."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from facediff import registry
from facediff.models import samplers
from facediff.models.dual_path.recipe import log_snr_weights
from facediff.models.samplers import SCHEDULES, DpmSolverSampler, NoiseProcess, Sampler, unit_noise, visited


@pytest.mark.parametrize("steps", [1, 10, 999, 1000])
@pytest.mark.parametrize("schedule", SCHEDULES)
def test_schedules_are_their_formulas_in_float32(schedule: str, steps: int) -> None:
    """Checkpoints were trained with these very numbers: rounded once from the formula, multiplied in float64."""
    process, n = NoiseProcess(steps, schedule), np.arange(steps)
    if schedule == "squaredcos_cap_v2":
        curve = np.cos((np.arange(steps + 1) / steps + 0.008) / 1.008 * np.pi / 2) ** 2
        np.testing.assert_array_equal(process.variances, np.minimum(1 - curve[1:] / curve[:-1], 0.999).astype("f4"))
    else:
        power = 1 if schedule == "linear" else 2
        first, last = np.float32(0.0001 ** (1 / power)), np.float32(0.02 ** (1 / power))
        width = float((last - first) / np.float32(max(1, steps - 1)))
        line = np.where((n < steps // 2) | (steps == 1), first + width * n, last - width * (steps - 1 - n))
        np.testing.assert_array_max_ulp(process.variances.numpy(), line.astype("f4") ** power, maxulp=2)
    kept = np.cumprod((np.float32(1) - process.variances.numpy()).astype("f8")).astype("f4")
    np.testing.assert_array_equal(process.signal, kept)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_add_noise_is_the_product_of_single_steps(schedule: str) -> None:
    process = NoiseProcess(60, schedule)
    step = torch.arange(60)
    ones, zeros = torch.ones(60, 1), torch.zeros(60, 1)
    signal = process.add_noise(ones, zeros, step)[:, 0].double().numpy()
    noise = process.add_noise(zeros, ones, step)[:, 0].double().numpy()
    mean, variance = 1.0, 0.0
    for n, alpha in enumerate(process.variances.double().numpy()):
        mean, variance = np.sqrt(1 - alpha) * mean, (1 - alpha) * variance + alpha  # eq. 1
        assert signal[n] == pytest.approx(mean, rel=1e-4)
        assert noise[n] ** 2 == pytest.approx(variance, rel=2e-3)


def test_steps_are_drawn_in_proportion_to_their_weights() -> None:
    process, weights = NoiseProcess(10), torch.arange(1.0, 11.0)
    torch.manual_seed(0)
    counts = torch.bincount(process.draw_steps(40_000, torch.device("cpu"), weights=weights), minlength=10)
    torch.testing.assert_close(counts / 40_000, weights / 55, atol=0.01, rtol=0)
    for how in ({"weights": weights}, {}):
        drawn = [process.draw_steps(9, torch.device("cpu"), torch.Generator().manual_seed(3), **how) for _ in range(2)]
        assert torch.equal(*drawn), how


def test_steps_are_even_in_log_snr_where_noise_hides_part_of_the_motion() -> None:
    process = NoiseProcess(1000, scale=0.1)
    signal = process.signal.double().numpy()
    level = np.log(signal / (1 - signal))
    hidden = 1 / (1 + 300 * signal / (1 - signal))  # of Gaussian motion of variance 300
    weights = log_snr_weights(process, torch.from_numpy(hidden)).double().numpy()
    np.testing.assert_allclose(weights.sum(), 1, rtol=1e-5)
    among = (hidden >= 0.005) & (hidden < 0.7)
    first, last = np.flatnonzero(among)[[0, -1]]  # the steps next to these have a part of the way to them
    np.testing.assert_allclose(np.concatenate([weights[: first - 1], weights[last + 2 :]]), 0.15 / 1000, rtol=1e-5)
    top, bottom = level[among].max(), level[among].min()
    for high in np.linspace(top, bottom, 6)[:-1]:
        low = high - (top - bottom) / 5
        chosen = (level <= high) & (level >= low)
        # An interval's share of 85 %, besides its steps' share of 15 %, up to one step at either end.
        np.testing.assert_allclose(weights[chosen].sum(), 0.17 + 0.15 * chosen.mean(), atol=0.01)
    drawn = process.draw_steps(40_000, torch.device("cpu"), weights=torch.from_numpy(weights))
    assert float((drawn > 900).double().mean()) == pytest.approx(weights[901:].sum(), abs=0.01)


def test_steps_are_even_where_noise_hides_everything_or_nothing() -> None:
    for hidden in (torch.zeros(10), torch.ones(10)):
        torch.testing.assert_close(log_snr_weights(NoiseProcess(10), hidden), torch.full((10,), 0.1))


def test_unit_noise_does_not_depend_on_the_number_of_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samplers, "PART", 100)
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        found.append(unit_noise((3, 7, 50), torch.device("cpu"), torch.Generator().manual_seed(5)))
    assert torch.equal(*found)
    assert found[0].shape == (3, 7, 50)
    assert not torch.equal(found[0], unit_noise((3, 7, 50), torch.device("cpu"), torch.Generator().manual_seed(6)))
    with torch.inference_mode():
        assert torch.equal(found[0], unit_noise((3, 7, 50), torch.device("cpu"), torch.Generator().manual_seed(5)))


def test_unit_noise_is_unit_gaussian_with_independent_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(samplers, "PART", 10_000)
    noise = unit_noise((20, 10_000), torch.device("cpu"), torch.Generator().manual_seed(0)).double()
    # Standard errors: 1 / √200 000 for the mean, √(2 / 200 000) for the variance, 1 / √10 000 between rows.
    assert abs(float(noise.mean())) < 4 / 200_000**0.5
    assert abs(float(noise.var()) - 1) < 4 * (2 / 200_000) ** 0.5
    assert float((torch.corrcoef(noise) - torch.eye(20)).abs().max()) < 0.05


NAMES = registry.sampler.names()
every_sampler = pytest.mark.parametrize("name", NAMES)


def make(name: str, process: NoiseProcess, **options: Any) -> Sampler:  # noqa: ANN401
    return registry.sampler.get(name)(process=process, **options)


def noise_of(seed: int) -> Callable[[Tensor], Tensor]:
    generator = torch.Generator().manual_seed(seed)
    return lambda like: torch.randn(like.shape, generator=generator)


def trace(
    sampler: Sampler, predict: Callable[[Tensor, int], Tensor], start: Tensor, seed: int = 0
) -> tuple[list[int], list[Tensor]]:
    """The steps that were asked for, and the motion before each of them and at the end."""
    steps: list[int] = []
    motions: list[Tensor] = []

    def denoise(noisy: Tensor, step: int) -> Tensor:
        steps.append(step)
        motions.append(noisy.clone())
        return predict(noisy, step)

    motions.append(sampler.run(denoise, start, noise=noise_of(seed)))
    return steps, motions


@every_sampler
def test_sampler_of_gaussian_data_keeps_mean_and_deviation(name: str) -> None:
    """For data N(m, s²) the best denoiser E[M⁰ | Mⁿ] is known, so the samples' distribution is too."""
    process = NoiseProcess(1000)
    mean, deviation = torch.tensor([0.7, -1.5]), torch.tensor([0.3, 1.4])

    def predict(noisy: Tensor, step: int) -> Tensor:
        kept = process.signal[step]
        weight = kept * deviation**2 + 1 - kept
        return (mean * (1 - kept) + kept.sqrt() * deviation**2 * noisy) / weight

    options = {} if name == "ddpm" else {"steps": 150}
    start = torch.randn(20_000, 2, generator=torch.Generator().manual_seed(1))
    samples = make(name, process, **options).run(predict, start, noise=noise_of(2))
    torch.testing.assert_close(samples.mean(0), mean, rtol=0, atol=0.03)
    torch.testing.assert_close(samples.std(0), deviation, rtol=0.025, atol=0)


def test_spread_takes_samples_twice_that_factor_further_from_the_mean() -> None:
    """Of Gaussian data, where all is linear: once by louder noise, once by distance from the first prediction."""
    process, mean, deviation = NoiseProcess(1000), 0.7, 0.8

    def predict(noisy: Tensor, step: int) -> Tensor:
        kept = process.signal[step]
        weight = kept * deviation**2 + 1 - kept
        return (mean * (1 - kept) + kept.sqrt() * deviation**2 * noisy) / weight

    start = torch.randn(2_000, 1, generator=torch.Generator().manual_seed(1))
    plain = DpmSolverSampler(process=process, steps=4).run(predict, start)
    for spread in (1.3, 2.0):
        wide = DpmSolverSampler(process=process, steps=4, spread=spread).run(predict, start)
        torch.testing.assert_close(wide - mean, spread**2 * (plain - mean), rtol=0.01, atol=0.01)
    once = DpmSolverSampler(process=process, steps=1, spread=1.3).run(predict, start)
    torch.testing.assert_close(once, predict(start, 999))


@pytest.mark.parametrize("steps", [20, 7])
def test_ddpm_run_is_the_formula_with_the_same_noise(steps: int) -> None:
    """The whole run against Ho et al. 2020, eq. 6 and 7, in NumPy's float64."""
    process = NoiseProcess(20)
    sampler = make("ddpm", process, steps=steps)
    start, fresh = torch.randn(3, 4, 5).double(), [torch.randn(3, 4, 5).double() for _ in range(steps)]
    queue = iter(fresh)
    ours = sampler.run(lambda x, _: x.tanh(), start, noise=lambda _: next(queue))
    expected, kept = start.numpy(), [*process.signal.double().numpy()[sampler.timesteps], 1.0]
    for i in range(steps):
        now, then = kept[i], kept[i + 1]
        alpha = 1 - now / then
        clean = np.tanh(expected)
        mean = np.sqrt(then) * alpha / (1 - now) * clean + np.sqrt(1 - alpha) * (1 - then) / (1 - now) * expected
        expected = mean + np.sqrt((1 - then) / (1 - now) * alpha) * fresh[i].numpy()
    np.testing.assert_allclose(ours.numpy(), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("steps", [20, 7, 15])
@pytest.mark.parametrize("eta", [0.0, 0.4, 1.0])
def test_ddim_step_is_the_published_update(steps: int, eta: float) -> None:
    """Song et al. 2021, eq. 12 with the σ of eq. 16; at η = 1 it is ddpm's posterior."""
    process, shape = NoiseProcess(20), (400, 100)
    truth = torch.randn(shape, generator=torch.Generator().manual_seed(9))
    seen, motions = trace(make("ddim", process, steps=steps, eta=eta), lambda *_: truth, torch.randn(shape))
    kept = process.signal.double().numpy()
    for i in range(steps - 1):
        now, then = kept[seen[i]], kept[seen[i + 1]]
        sigma = eta * np.sqrt((1 - then) / (1 - now)) * np.sqrt(1 - now / then)
        noise = (motions[i] - np.sqrt(now) * truth) / np.sqrt(1 - now)
        mean = np.sqrt(then) * truth + np.sqrt(1 - then - sigma**2) * noise
        residual = (motions[i + 1] - mean).numpy()
        if eta == 0:
            np.testing.assert_allclose(residual, 0, atol=1e-5)
        else:
            assert residual.mean() == pytest.approx(0, abs=0.02 * sigma)
            assert residual.std() == pytest.approx(sigma, rel=0.02)


DPM_STEPS = (1, 2, 3, 7, 14, 15, 20)
DPM_VALUES = {
    1: (-0.941550, 0.617272, 0.694404, 0.718046, 0.734336, 0.734863, 0.738189),
    2: (-0.941550, 0.617272, 0.671152, 0.665244, 0.716250, 0.718877, 0.727936),
    3: (-0.941550, 0.617272, 0.671152, 0.662500, 0.716418, 0.726537, 0.732778),
}
"""What DPMSolverMultistepScheduler of diffusers 0.42.1 gave on the same steps, by order."""


@pytest.mark.parametrize("order", [1, 2, 3])
def test_dpm_solver_gives_the_published_implementations_values(order: int) -> None:
    process, start = NoiseProcess(1000), torch.tensor([0.8])
    found = [
        float(make("dpm_solver", process, steps=steps, order=order).run(lambda x, n: torch.cos(x + n / 500), start))
        for steps in DPM_STEPS
    ]
    np.testing.assert_allclose(found, DPM_VALUES[order], rtol=0, atol=5e-6)


LINEAR = [name for name in NAMES if registry.sampler.get(name).linear]
VARIANTS = [(name, {}) for name in LINEAR] + [("ddim", {"eta": 0.6}), ("dpm_solver", {"order": 1})]
VARIANTS += [("dpm_solver", {"order": 3})]


@pytest.mark.parametrize(("name", "options"), VARIANTS)
@pytest.mark.parametrize("steps", [2, 7, 20])
def test_linear_sampler_commutes_with_linear_maps(name: str, options: dict[str, float], steps: int) -> None:
    """Run on A x, with predictions A x̂₀ and noise A z, it gives A times what it gives on x."""
    sampler = make(name, NoiseProcess(20), steps=steps, **options)
    generator = torch.Generator().manual_seed(0)
    image = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    start, *rest = torch.randn(2 * steps + 1, 4, 5, generator=generator, dtype=torch.float64)
    predictions, fresh = rest[:steps], rest[steps:]
    runs = []
    for through in (torch.eye(5, dtype=torch.float64), image):
        clean, noise = iter(predictions), iter(fresh)
        states = []

        def predict(state: Tensor, _: int) -> Tensor:
            states.append(state)  # noqa: B023
            return next(clean) @ through  # noqa: B023

        sampler.run(predict, start @ through, noise=lambda _: next(noise) @ through)  # noqa: B023
        runs.append(torch.stack(states))
    torch.testing.assert_close(runs[0] @ image, runs[1], rtol=0, atol=1e-10)


def log_snr(process: NoiseProcess, places: Sequence[int]) -> np.ndarray:
    kept = process.signal.double().numpy()[list(places)]
    return np.log(kept / (1 - kept)) / 2


@pytest.mark.parametrize("first_noise", [None, 40.0])
@pytest.mark.parametrize("scale", [1.0, 0.1])
@pytest.mark.parametrize("steps", [2, 5, 10])
def test_log_snr_spacing_is_even_in_the_solvers_time(scale: float, steps: int, first_noise: float | None) -> None:
    process = NoiseProcess(scale=scale)
    options = {"steps": steps, "spacing": "log_snr", "last_noise": 0.5, "first_noise": first_noise}
    places = DpmSolverSampler(process=process, **options).timesteps  # type: ignore[arg-type]
    assert places[0] == 999
    assert len(set(places)) == len(places) == steps
    times = log_snr(process, places)
    assert math.exp(-times[-1]) == pytest.approx(0.5, rel=0.05)
    # The noisiest steps of the process lie far apart in this time, so some cannot be met exactly.
    even = np.linspace(times[0] if first_noise is None else -math.log(first_noise), times[-1], steps)
    every = log_snr(process, range(1000))
    nearest = np.abs(every[None] - even[:, None]).min(1)
    # Where steps of the process are rarer than those wanted, each is visited once, and the next ones move on.
    assert (np.abs(times - even) <= nearest + 0.05)[1:][even[1:] > every[990]].all()


@pytest.mark.parametrize("name", ["ddim", "dpm_solver", "ddpm"])
@pytest.mark.parametrize("spacing", ["steps", "log_snr"])
@pytest.mark.parametrize("steps", [1, 2, 61, 103, 600])
@pytest.mark.parametrize("last_noise", [None, 0.01, 0.3])
def test_any_spacing_visits_each_step_once(name: str, spacing: str, steps: int, last_noise: float | None) -> None:
    made = registry.sampler.get(name)(process=NoiseProcess(), steps=steps, spacing=spacing, last_noise=last_noise)
    places = made.timesteps
    assert len(places) == steps
    assert places[0] == 999
    assert places == sorted(set(places), reverse=True)
    assert places[-1] >= 0
    assert places == visited(made.process, steps, spacing, last_noise)
    if last_noise is not None and steps > 1:
        assert math.exp(-log_snr(made.process, places[-1:])[0]) == pytest.approx(last_noise, rel=0.2)
    assert torch.equal(
        DpmSolverSampler(process=made.process, steps=steps, spacing=spacing, last_noise=last_noise).run(
            lambda noisy, step: torch.ones_like(noisy), torch.randn(2, 3)
        ),
        torch.ones(2, 3),
    )
