"""Correlations of the lips with the truth's and with the voice: what has none, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from facediff.metrics import (
    ClipSpeechLipCorrelation,
    Coverage,
    LipOpeningCorrelation,
    clip_speech_lip_correlation,
    lip_opening_correlation,
    lip_speed_correlation,
    speech_intensity,
)
from facediff.metrics.mouth import correlation

Anything = Any  # right and wrong speech


def motion(seed: int, batch: int = 2, frames: int = 8) -> torch.Tensor:
    return torch.randn(batch, frames, 4, 3, generator=torch.manual_seed(seed))


def test_a_still_prediction_counts_zero_and_a_still_truth_is_left_out() -> None:
    still = motion(0)[:, :1].expand(2, 8, 4, 3)
    for correlate in (lip_opening_correlation, lip_speed_correlation):
        region: Anything = [(0, 1), (2, 3)] if correlate is lip_opening_correlation else [0, 1]
        assert correlate(still, motion(1), region).item() == 0
        with pytest.raises(ValueError, match="has no value on any of its 2 sequences.*does not vary"):
            correlate(motion(1), still, region)
    metric = LipOpeningCorrelation([(0, 1)])
    metric.update(motion(1), torch.cat([still[:1], motion(2)[:1]]))
    assert metric.coverage() == Coverage(8, 1, 0, 0, left_out=1)
    assert metric.compute() == lip_opening_correlation(motion(1)[1], motion(2)[0], [(0, 1)])


def test_a_face_that_is_still_up_to_rounding_is_still() -> None:
    neutral = torch.rand(4, 3, generator=torch.manual_seed(3))
    nearly = torch.zeros(1, 8, 4, 3, dtype=torch.float64)
    nearly[:, ::2] += 1e-17
    assert lip_opening_correlation(nearly, motion(1)[:1].double(), [(0, 1)], offsets_from=neutral).item() == 0


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize(("share", "varies"), [(1.1e-12, True), (0.9e-12, False)])
def test_a_series_varies_by_more_than_rounding(share: float, varies: bool, sign: int) -> None:
    """Its range against its largest absolute value, whatever its unit and its sign."""
    base = sign * torch.tensor([2.0, 2.0 + 2 * share, 2.0, 2.0 + 2 * share], dtype=torch.float64)
    other = torch.tensor([0.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    for unit in (1.0, 1e-6, 1e6):
        assert float(correlation(other, unit * base)) == pytest.approx(sign if varies else 0, abs=1e-3)
        assert bool(correlation(unit * base, other).isnan()) != varies
    assert correlation(other[:1], base[:1]).isnan()
    assert float(correlation(other[:2], other[:2].flip(0))) == -1


def test_lips_that_do_not_vary_follow_no_voice() -> None:
    still = torch.zeros(2, 8, 4, 3)
    loud = torch.rand(2, 8, generator=torch.manual_seed(0))
    assert clip_speech_lip_correlation(still, motion(0), [0], intensity=loud).item() == 0
    monotone = torch.full((2, 8), 0.3)
    with pytest.raises(ValueError, match="on any of its 2 sequences: no identity has two clips"):
        clip_speech_lip_correlation(motion(0), motion(1), [0], intensity=monotone)


def test_identities_that_say_nothing_do_not_enter() -> None:
    prediction, truth = motion(0, batch=6), motion(1, batch=6)
    loud = torch.rand(6, 8, generator=torch.manual_seed(0))
    loud[3:5] = 0.5  # identity 1 is always as loud; identity 2 has a single clip
    metric = ClipSpeechLipCorrelation([0, 1], n_identities=4)
    metric.update(prediction, truth, intensity=loud, identities=[0, 0, 0, 1, 1, 2])
    assert metric.coverage() == Coverage(frames=24, sequences=3, cut_prediction=0, cut_truth=0, left_out=3)
    assert metric.compute() == clip_speech_lip_correlation(prediction[:3], truth[:3], [0, 1], intensity=loud[:3])


def test_sound_may_end_within_the_last_frame() -> None:
    samples = np.random.default_rng(0).standard_normal(100)
    # The sound may end within the last frame, of samples 66 to 82, not before it.
    short = speech_intensity(torch.from_numpy(samples[:70]), 5, 410, 25)
    assert short[4].item() == pytest.approx(np.sqrt(np.mean(samples[66:70] ** 2)))
    with pytest.raises(ValueError, match="the speech has 66 samples, 5 frames reach to sample 82"):
        speech_intensity(torch.from_numpy(samples[:66]), 5, 410, 25)
