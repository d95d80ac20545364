"""The four losses against NumPy in float64, written from the equations clip by clip, without padding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from facediff import losses

Array = NDArray[np.float64]
Clips = list[Array]
VERTICES = 6
REGION = [1, 4, 5]
LENGTHS = (7, 3, 2, 1, 12)
GARBAGE = 1e3


def huber_numpy(gap: Array) -> Array:
    size = np.abs(gap)
    return np.where(size <= 1, 0.5 * gap**2, size - 0.5)


def difference_numpy(truths: Clips, predictions: Clips, order: int) -> float:
    """Mean over all coordinates of all differences that lie inside a clip; 0 if there is none."""
    gaps = [np.diff(t, order, axis=0) - np.diff(p, order, axis=0) for t, p in zip(truths, predictions, strict=True)]
    gaps = [gap for gap in gaps if len(gap)]
    return float(huber_numpy(np.concatenate(gaps)).mean()) if gaps else 0.0


def face_numpy(truths: Clips, predictions: Clips) -> float:
    terms = []
    for truth, prediction in zip(truths, predictions, strict=True):
        true, predicted = (np.linalg.norm(m, axis=-1)[:, REGION].std(axis=0) for m in (truth, prediction))
        terms.append(np.abs(true - predicted).mean())
    return float(np.mean(terms))


REFERENCES: dict[str, Callable[[Clips, Clips], float]] = {
    "reconstruction": lambda truths, predictions: difference_numpy(truths, predictions, 0),
    "velocity": lambda truths, predictions: difference_numpy(truths, predictions, 1),
    "acceleration": lambda truths, predictions: difference_numpy(truths, predictions, 2),
    "face": face_numpy,
}


def loss(name: str, prediction: Tensor, truth: Tensor, mask: Tensor) -> Tensor:
    if name == "face":
        return losses.face_dynamics_loss(prediction, truth, mask, torch.tensor(REGION))
    function: Callable[[Tensor, Tensor, Tensor], Tensor] = getattr(losses, f"{name}_loss")
    return function(prediction, truth, mask)


def clips(lengths: tuple[int, ...], seed: int) -> Clips:
    # A spread of two puts gaps on both sides of the Huber loss's bend at one.
    rng = np.random.default_rng(seed)
    return [2 * rng.standard_normal((frames, VERTICES, 3)) for frames in lengths]


def pad(motions: Clips, extra: int = 0) -> tuple[Tensor, Tensor]:
    frames = max(map(len, motions)) + extra
    padded = torch.full((len(motions), frames, VERTICES, 3), GARBAGE, dtype=torch.float64)
    mask = torch.zeros(len(motions), frames, dtype=torch.bool)
    for row, motion in enumerate(motions):
        padded[row, : len(motion)] = torch.from_numpy(motion)
        mask[row, : len(motion)] = True
    return padded, mask


@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("lengths", [(9,), LENGTHS, (2,), (1,), (2, 1)], ids=str)
@pytest.mark.parametrize("extra", [0, 4])
def test_against_numpy(name: str, lengths: tuple[int, ...], extra: int) -> None:
    truths, predictions = clips(lengths, 0), clips(lengths, 1)
    (truth, mask), (prediction, _) = pad(truths, extra), pad(predictions, extra)
    prediction[~mask] *= -1
    expected = REFERENCES[name](truths, predictions)
    assert float(loss(name, prediction, truth, mask)) == pytest.approx(expected, rel=1e-12, abs=0)


@pytest.mark.parametrize("name", REFERENCES)
def test_padding_changes_nothing_in_float32(name: str) -> None:
    truths, predictions = clips((6,), 2), clips((6,), 3)
    values = []
    for extra in (0, 1, 5):
        (truth, mask), (prediction, _) = pad(truths, extra), pad(predictions, extra)
        prediction[~mask] *= -1
        values.append(loss(name, prediction.float(), truth.float(), mask))
    torch.testing.assert_close(values[1:], [values[0]] * 2, rtol=2e-7, atol=0)


@pytest.mark.parametrize("name", REFERENCES)
def test_gradient_is_that_of_the_formula_and_zero_on_padding(name: str) -> None:
    truths, predictions = clips((5, 3), 4), clips((5, 3), 5)
    (truth, mask), (prediction, _) = pad(truths, 2), pad(predictions, 2)
    loss(name, prediction.requires_grad_(), truth, mask).backward()
    assert prediction.grad is not None
    assert not prediction.grad[~mask].any()
    place = (1, REGION[0], 2)
    small = 1e-6
    sides = []
    for sign in (1, -1):
        moved = [p.copy() for p in predictions]
        moved[0][place] += sign * small
        sides.append(REFERENCES[name](truths, moved))
    slope = (sides[0] - sides[1]) / (2 * small)
    assert slope != 0
    assert float(prediction.grad[(0, *place)]) == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("frames", [1, 2])
def test_short_clips_have_no_acceleration_and_single_frames_no_velocity(frames: int) -> None:
    (truth, mask), (prediction, _) = pad(clips((frames,), 6)), pad(clips((frames,), 7))
    prediction.requires_grad_()
    acceleration = losses.acceleration_loss(prediction, truth, mask)
    velocity = losses.velocity_loss(prediction, truth, mask)
    assert acceleration.item() == 0.0
    assert (velocity.item() == 0.0) == (frames == 1)
    (acceleration + velocity + losses.reconstruction_loss(prediction, truth, mask)).backward()
    assert torch.isfinite(prediction.grad).all()


@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("value", [0.0, 0.3])
def test_gradient_is_finite_without_any_motion(name: str, value: float) -> None:
    prediction = torch.full((2, 5, VERTICES, 3), value, requires_grad=True)
    mask = torch.ones(2, 5, dtype=torch.bool)
    loss(name, prediction, torch.zeros_like(prediction), mask).backward()
    assert torch.isfinite(prediction.grad).all()


def test_face_loss_sees_its_region_only() -> None:
    (truth, mask), (prediction, _) = pad(clips((8,), 8)), pad(clips((8,), 9))
    before = loss("face", prediction, truth, mask)
    outside = [v for v in range(VERTICES) if v not in REGION]
    prediction[:, :, outside] += torch.randn(1, 8, len(outside), 3, dtype=torch.float64)
    assert torch.equal(loss("face", prediction, truth, mask), before)
    prediction[:, 0, REGION[0]] += 1
    assert not torch.equal(loss("face", prediction, truth, mask), before)


def test_face_loss_compares_deviations_not_positions() -> None:
    (truth, mask) = pad(clips((8,), 10))
    assert loss("face", truth.flip(1), truth, mask).item() == pytest.approx(0, abs=1e-12)
    assert loss("face", truth * 3, truth, mask).item() == pytest.approx(
        2 * np.linalg.norm(truth[0].numpy(), axis=-1)[:, REGION].std(axis=0).mean()
    )
