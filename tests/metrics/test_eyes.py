"""Blinks against series whose number is known."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

import facediff.metrics as fm
from facediff.metrics.eyes import count_blinks

LIDS = [(0, 1)]


def face(opening: Tensor) -> Tensor:
    """Absolute vertices (…, 2, 3) of a face whose eyes are open so far."""
    return opening[..., None, None] * torch.tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0]])


def blinking(*at: int, frames: int = 120, depth: float = 0.9, open_to: float = 1.0) -> Tensor:
    opening = torch.full((frames,), open_to, dtype=torch.float64)
    for place in at:
        opening[place : place + 4] = open_to * (1 - depth)
    return opening


@pytest.mark.parametrize(
    ("opening", "blinks"),
    [
        (blinking(), 0),
        (blinking(20, 60, 100), 3),
        (blinking(0, 60), 2),  # shut in the first frame
        (blinking(20, 60, depth=0.49), 0),
        (blinking(20, 60, depth=0.51), 2),
        (blinking(20, 60, open_to=0.4), 2),  # heavy lids: the share is of their own usual opening
        (torch.zeros(50), 0),
    ],
)
def test_blinks_are_counted(opening: Tensor, blinks: int) -> None:
    assert count_blinks(opening).item() == blinks


def test_a_blink_is_over_only_when_the_eyes_are_nearly_open_again() -> None:
    trembling = torch.tensor([1.0, 1, 1, 0.2, 0.65, 0.2, 0.65, 0.2, 1, 1, 1])  # 0.65 open is 0.35 shut
    assert count_blinks(trembling).item() == 1
    assert count_blinks(trembling, reopened=0.4).item() == 3
    with pytest.raises(ValueError, match="reopened"):
        fm.BlinkRateRatio(LIDS, closed=0.3, reopened=0.4)


def test_a_blink_is_beyond_its_limits_and_not_at_them() -> None:
    at, beyond = torch.tensor([1.0, 1, 1, 0.5, 1, 1, 1]), torch.tensor([1.0, 1, 1, 0.499, 1, 1, 1])
    assert (count_blinks(at).item(), count_blinks(beyond).item()) == (0, 1)
    ajar, apart = (torch.tensor([1.0, 1, 1, 0.1, open_to, 0.1, 1, 1, 1]) for open_to in (0.75, 0.76))
    found = [count_blinks(each, closed=0.5, reopened=0.25).item() for each in (ajar, apart)]
    assert found == [1, 2]


def test_limits_count_what_they_say() -> None:
    half, wide = face(blinking(20, 60, depth=0.6, frames=100)), face(blinking(20, frames=100))
    for options, ratio in (({}, 2.0), ({"closed": 0.7}, 0.0), ({"closed": 0.05, "reopened": 0.01}, 2.0)):
        assert fm.blink_rate_ratio(half, wide, LIDS, **options).item() == ratio  # type: ignore[arg-type]


def test_the_ratio_is_one_of_sums_and_the_rate_one_of_minutes() -> None:
    predictions = torch.stack([face(blinking(30, frames=100)), face(blinking(frames=100))])
    truths = torch.stack([face(blinking(20, 50, 80, frames=100)), face(blinking(20, frames=100))])
    assert fm.blink_rate_ratio(predictions, truths, LIDS).item() == 0.25
    assert fm.blink_rate_ratio(predictions, truths, LIDS, lengths=[60, 100]).item() == pytest.approx(1 / 3)
    rates = [fm.blink_rate(predictions, truths, LIDS, frames_per_second=20, of=of) for of in ("prediction", "truth")]
    assert [rate.item() for rate in rates] == [pytest.approx(6.0), pytest.approx(24.0)]  # in 10 seconds
    offsets = predictions - face(torch.ones(1))
    neutral = face(torch.ones(1))[0]
    metric = fm.BlinkRate(LIDS, frames_per_second=20)
    assert metric.definition.startswith("blinks of the prediction over minutes at 20 frames a second")
    metric.update(offsets, offsets, offsets_from=neutral)
    assert metric.compute().item() == pytest.approx(6.0)
    with pytest.raises(ValueError, match="frames_per_second"):
        fm.BlinkRate(LIDS)
    with pytest.raises(ValueError, match="nobody blinks"):
        fm.blink_rate_ratio(truths, face(torch.ones(2, 100)), LIDS)


def test_lids_that_wander_have_the_variance_of_blinks_and_drift() -> None:
    """NumPy's definition, on lids that blink and on lids of the same variance that never rest."""
    random = np.random.default_rng(0)
    resting = np.full(400, 2.0) + 0.01 * random.standard_normal(400)
    for start in range(20, 400, 80):
        resting[start : start + 5] = 0.1
    wandering = 2.0 + resting.std() * random.standard_normal(400)

    def drift(opening: np.ndarray) -> float:
        shut = 1 - opening / np.quantile(opening, 0.5)
        return float(np.abs(shut[shut < 0.3]).mean())

    made, true = (face(torch.from_numpy(opening)) for opening in (wandering, resting))
    found = fm.eyelid_drift(made, true, LIDS).item()
    assert found == pytest.approx(drift(wandering) / drift(resting))
    assert found > 5
    assert fm.motion_liveliness(made, true).item() == pytest.approx(1, abs=0.1)
    assert fm.eyelid_drift(face(torch.zeros(20)), true[:20], LIDS).item() == 0  # shut throughout
    both = fm.EyelidDrift(LIDS)
    for frames in (100, 400):
        both.update(made[None, :frames], true[None, :frames])
    sums = [100 * drift(each[:100]) + 400 * drift(each) for each in (wandering, resting)]
    assert both.compute().item() == pytest.approx(sums[0] / sums[1])
