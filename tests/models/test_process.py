"""The forward process against equation 1 of the paper."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from facediff.errors import FaceDiffError
from facediff.models.samplers import SCHEDULES, NoiseProcess


@pytest.mark.parametrize("steps", [10, 1000])
def test_cosine_schedule_is_the_published_one(steps: int) -> None:
    """Nichol and Dhariwal 2021, eq. 17, with their s = 0.008 and their cap of 0.999."""

    def curve(t: np.ndarray) -> np.ndarray:
        return np.cos((t / steps + 0.008) / 1.008 * np.pi / 2) ** 2

    n = np.arange(steps)
    expected = np.minimum(1 - curve(n + 1) / curve(n), 0.999)
    process = NoiseProcess(steps)
    np.testing.assert_allclose(process.variances.numpy(), expected, rtol=1e-5)
    np.testing.assert_allclose(process.signal.numpy(), np.cumprod(1 - expected), rtol=1e-3)
    assert process.signal[-1] < 1e-4  # the process ends in pure noise, from which sampling starts


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


def test_unknown_schedule_is_refused() -> None:
    with pytest.raises(FaceDiffError, match='"cosine".*squaredcos_cap_v2'):
        NoiseProcess(10, "cosine")


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


def test_add_noise_has_the_statistics_of_simulated_noising() -> None:
    process, samples, last = NoiseProcess(25), 40_000, 14
    generator = torch.Generator().manual_seed(0)
    clean = torch.tensor([1.5, -0.5]).expand(samples, 2)
    noisy = clean.clone()
    for alpha in process.variances[: last + 1]:
        noisy = (1 - alpha).sqrt() * noisy + alpha.sqrt() * torch.randn(samples, 2, generator=generator)
    noise = torch.randn(samples, 2, generator=generator)
    closed = process.add_noise(clean, noise, torch.full((samples,), last))
    torch.testing.assert_close(closed.mean(0), noisy.mean(0), rtol=0, atol=0.02)
    torch.testing.assert_close(closed.std(0), noisy.std(0), rtol=0.015, atol=0)


def test_add_noise_takes_each_clips_own_step() -> None:
    process = NoiseProcess(30)
    clean, noise, step = torch.randn(3, 4, 6), torch.randn(3, 4, 6), torch.tensor([29, 0, 11])
    together = process.add_noise(clean, noise, step)
    for i in range(3):
        kept = process.signal[step[i]]
        torch.testing.assert_close(together[i], kept.sqrt() * clean[i] + (1 - kept).sqrt() * noise[i])


def test_draw_steps_covers_the_process_evenly() -> None:
    torch.manual_seed(0)
    counts = torch.bincount(NoiseProcess(10).draw_steps(20_000, torch.device("cpu")), minlength=10)
    assert len(counts) == 10
    assert ((counts - 2000).abs() < 250).all()
