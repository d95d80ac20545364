"""What only generation metrics see: a regressor, a calibrated model and an over-dispersed one are told apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import facediff.metrics as fm


def draws(spread: float, *, samples: int = 6, mean: float = 0.0) -> tuple[Tensor, Tensor]:
    """Samples and the truth of a motion of which half of the variance is known, (samples, frames, vertices, 3)."""
    random = torch.Generator().manual_seed(3)
    known = torch.randn(400, 5, 3, generator=random)
    truth = known + torch.randn(400, 5, 3, generator=random)
    return known + mean + spread * torch.randn(samples, 400, 5, 3, generator=random), truth


@pytest.mark.parametrize(("spread", "ratio"), [(0.0, 0.0), (1.0, 1.0), (2.0, 2 * (2 / 5) ** 0.5)])
def test_spread_over_error_is_one_for_a_calibrated_model(spread: float, ratio: float) -> None:
    # Differences are Gaussian: √2 s between samples, √(1 + s²) between sample and truth.
    samples, truth = draws(spread)
    assert fm.spread_error_ratio(samples, truth).item() == pytest.approx(ratio, abs=0.02)


def test_the_energy_score_is_best_for_the_right_spread() -> None:
    scores = {spread: fm.energy_score(*draws(spread)).item() for spread in (0.0, 0.5, 1.0, 1.5, 2.0)}
    assert min(scores, key=lambda spread: scores[spread]) == 1.0
    assert fm.energy_score(*draws(1.0, mean=0.5)).item() > scores[1.0]


def test_the_energy_score_of_equal_samples_is_the_distance() -> None:
    samples, truth = draws(0.0)
    distance = ((samples[0] - truth).square().sum((1, 2)) / 5).sqrt().mean().item()
    assert fm.energy_score(samples, truth).item() == pytest.approx(distance)


def test_the_energy_score_of_sequences_sees_motion_that_is_too_slow() -> None:
    # Frame by frame both have the right distribution; over time only one of them has.
    random = torch.Generator().manual_seed(0)
    truths = torch.randn(60, 40, 1, 3, generator=random)
    frozen = torch.randn(60, 8, 1, 1, 3, generator=random).expand(60, 8, 40, 1, 3)
    moving = torch.randn(60, 8, 40, 1, 3, generator=random)
    of_frames, of_sequences = (
        [fm.energy_score(each, truths, of=of).item() for each in (moving, frozen)] for of in ("frames", "sequences")
    )
    assert of_frames[0] == pytest.approx(of_frames[1], rel=0.01)
    assert of_sequences[0] < 0.96 * of_sequences[1]


def test_liveliness_of_a_regressor_is_the_explained_share() -> None:
    samples, truth = draws(0.0)
    assert fm.motion_liveliness(samples[0], truth).item() == pytest.approx(0.5**0.5, abs=0.02)


def test_one_still_truth_does_not_rule_the_liveliness() -> None:
    motion = torch.randn(2, 20, 3, 3, generator=torch.Generator().manual_seed(1))
    truth = motion.clone()
    truth[1] = 0.0
    metric = fm.MotionLiveliness()
    metric.update(motion * torch.tensor([2.0, 0.0])[:, None, None, None], truth)
    assert metric.compute().item() == pytest.approx(2.0)


def test_white_noise_shivers_by_the_root_of_three_and_a_calibrated_model_has_the_variance_of_its_error() -> None:
    noise = torch.randn(6, 3000, 4, 3, generator=torch.Generator().manual_seed(2))
    assert fm.difference_ratio(noise[0], noise[0], of="prediction").item() == pytest.approx(3**0.5, abs=0.02)
    assert fm.difference_ratio(noise[0], noise[1].cumsum(0)).item() == pytest.approx((3 / 2) ** 0.5, abs=0.02)
    assert fm.spread_error_ratio(noise[:4], noise[4], squared=True).item() == pytest.approx(1.0, abs=0.03)
    with pytest.raises(ValueError, match="DifferenceRatio"):
        fm.difference_ratio(torch.zeros(5, 3, 3), noise[0, :5, :3])


def test_spectrum_distance_is_deaf_to_time_and_hears_speed() -> None:
    place = torch.arange(200, dtype=torch.float64)

    def wave(cycles: float, phase: float) -> torch.Tensor:
        return torch.sin(2 * torch.pi * (cycles * place + phase))[:, None, None].expand(-1, 2, 3)

    truth = wave(0.1, 0.0)
    assert fm.spectrum_distance(wave(0.1, 0.3), truth).item() < 3
    assert fm.spectrum_distance(wave(0.3, 0.0), truth).item() > 15
    still = fm.spectrum_distance(torch.zeros_like(truth), truth).item()
    assert np.isfinite(still)
    assert still > 15
    with pytest.raises(ValueError, match="truth does not move"):
        fm.spectrum_distance(truth, torch.zeros_like(truth))
