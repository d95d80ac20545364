"""The four losses against NumPy in float64, written from the equations clip by clip, without padding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torch import Tensor

from facediff.models import losses, losses_fused

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
def test_loss_against_numpy(name: str, lengths: tuple[int, ...], extra: int) -> None:
    truths, predictions = clips(lengths, 0), clips(lengths, 1)
    (truth, mask), (prediction, _) = pad(truths, extra), pad(predictions, extra)
    prediction[~mask] *= -1
    expected = REFERENCES[name](truths, predictions)
    assert float(loss(name, prediction, truth, mask)) == pytest.approx(expected, rel=1e-12, abs=0)


@pytest.mark.parametrize("name", REFERENCES)
def test_loss_gradient_is_that_of_the_formula_and_zero_on_padding(name: str) -> None:
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


@pytest.mark.parametrize("name", REFERENCES)
@pytest.mark.parametrize("value", [0.0, 0.3])
def test_loss_gradient_is_finite_without_any_motion(name: str, value: float) -> None:
    prediction = torch.full((2, 5, VERTICES, 3), value, requires_grad=True)
    mask = torch.ones(2, 5, dtype=torch.bool)
    loss(name, prediction, torch.zeros_like(prediction), mask).backward()
    assert torch.isfinite(prediction.grad).all()


WEIGHTS = {"reconstruction": 1.0, "velocity": 0.3, "acceleration": 0.7, "face": 0.5}
WIDTH = 4


def linear_parts(lengths: tuple[int, ...], extra: int, dtype: torch.dtype = torch.float64) -> list[Tensor]:
    """Features, map, constant, truth and mask; garbage on padding."""
    truth, mask = pad(clips(lengths, 11), extra)
    draw = torch.Generator().manual_seed(0)
    features = torch.full((*mask.shape, WIDTH), GARBAGE, dtype=torch.float64)
    features[mask] = torch.randn(sum(lengths), WIDTH, generator=draw, dtype=torch.float64)
    weight = torch.randn(3 * VERTICES, WIDTH, generator=draw, dtype=torch.float64)
    bias = torch.randn(3 * VERTICES, generator=draw, dtype=torch.float64)
    return [features.to(dtype), weight.to(dtype), bias.to(dtype), truth.to(dtype), mask]


def by_definition(
    features: Tensor, weight: Tensor, bias: Tensor, truth: Tensor, mask: Tensor, region: Tensor, scale: float
) -> dict[str, Tensor]:
    prediction = (features @ weight.T + bias).unflatten(2, (-1, 3))
    return losses.training_losses(prediction, scale * truth, mask, region, WEIGHTS)


@pytest.mark.parametrize("lengths", [(9,), LENGTHS, (2,), (1,), (2, 1)], ids=str)
@pytest.mark.parametrize("extra", [0, 4])
@pytest.mark.parametrize("block", [1, 40, 10**6], ids=lambda size: f"block{size}")
@pytest.mark.parametrize("region", [REGION, [0, 3, 3, 5], [2]], ids=str)
def test_fused_losses_are_their_definitions(
    lengths: tuple[int, ...], extra: int, block: int, region: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(losses_fused, "CACHE_SIZE", block)
    *parts, truth, mask = linear_parts(lengths, extra)
    found, expected = [], []
    for compute, results in ((losses_fused.fused_losses, found), (by_definition, expected)):
        leaves = [part.clone().requires_grad_() for part in parts]
        chosen = torch.tensor(region)
        if compute is by_definition:
            terms = by_definition(*leaves, truth, mask, chosen, 1.7)
        else:
            terms = losses_fused.fused_losses(*leaves, truth, mask, chosen, WEIGHTS, scale=1.7)
        (3 * terms["loss"]).backward()
        results += [terms, [leaf.grad for leaf in leaves]]
    torch.testing.assert_close(found[0], expected[0], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close(found[1], expected[1], rtol=1e-11, atol=1e-13)
    assert not found[1][0][~mask].any()


@pytest.mark.parametrize("wanted", [0, 1, 2])
def test_fused_losses_have_the_gradient_of_one_part_alone(wanted: int) -> None:
    """Features without a gradient are those of a frozen network, a map without one that of an adapted one."""
    *parts, truth, mask = linear_parts((6, 4), 1)
    found = []
    for fused in (True, False):
        leaves = [part.clone().requires_grad_(place == wanted) for place, part in enumerate(parts)]
        given = (*leaves, truth, mask, torch.tensor(REGION))
        terms = losses_fused.fused_losses(*given, WEIGHTS) if fused else by_definition(*given, 1.0)
        terms["loss"].backward()
        assert [leaf.grad is not None for leaf in leaves] == [place == wanted for place in range(3)]
        found.append(leaves[wanted].grad)
    torch.testing.assert_close(found[0], found[1], rtol=1e-11, atol=1e-13)


def test_fused_losses_of_a_clip_without_frames_are_their_definitions() -> None:
    """It adds nothing, and is no division by zero; a batch of such clips alone has the loss 0."""
    for lengths in ((5, 0, 3), (0, 0)):
        *parts, truth, mask = linear_parts(lengths, 2)
        leaves = [part.clone().requires_grad_() for part in parts]
        terms = losses_fused.fused_losses(*leaves, truth, mask, torch.tensor(REGION), WEIGHTS)
        expected = by_definition(*parts, truth, mask, torch.tensor(REGION), 1.0)
        torch.testing.assert_close(terms, expected, rtol=1e-12, atol=1e-14)
        terms["loss"].backward()
        assert all(torch.isfinite(leaf.grad).all() for leaf in leaves if leaf.grad is not None)
        assert (float(terms["loss"].detach()) == 0) == (sum(lengths) == 0)


def test_fused_losses_leave_alone_what_is_frozen_and_what_it_is_given() -> None:
    features, weight, bias, truth, mask = linear_parts((6, 4), 1)
    kept = [part.clone() for part in (features, weight, bias, truth)]
    region = torch.tensor(REGION)
    terms = losses_fused.fused_losses(features.requires_grad_(), weight, None, truth, mask, region, WEIGHTS)
    terms["loss"].backward()
    assert features.grad is not None
    assert weight.grad is None
    assert not any(term.requires_grad for name, term in terms.items() if name != "loss")
    expected = by_definition(features, weight, torch.zeros_like(bias), truth, mask, region, 1.0)
    torch.testing.assert_close(terms["loss"], expected["loss"], rtol=1e-12, atol=0)
    with torch.no_grad():
        unused = losses_fused.fused_losses(features, weight, bias.requires_grad_(), truth, mask, region, WEIGHTS)
    assert not unused["loss"].requires_grad
    assert all(torch.equal(now, before) for now, before in zip((features, weight, bias, truth), kept, strict=True))


def test_fused_losses_have_finite_gradients_without_any_motion() -> None:
    features, weight, bias, truth, mask = linear_parts((5, 3), 2)
    features = torch.zeros_like(features).requires_grad_()
    bias = torch.zeros_like(bias).requires_grad_()
    terms = losses_fused.fused_losses(features, weight, bias, truth, mask, torch.tensor(REGION), WEIGHTS)
    terms["loss"].backward()
    assert torch.isfinite(features.grad).all()
    assert torch.isfinite(bias.grad).all()


def test_fused_losses_in_bfloat16_predict_in_full_precision() -> None:
    *parts, truth, mask = linear_parts((9, 7), 1, torch.float32)
    region, results = torch.tensor(REGION), []
    for enabled in (False, True):
        leaves = [part.clone().requires_grad_() for part in parts]
        with torch.autocast("cpu", torch.bfloat16, enabled=enabled):
            terms = losses_fused.fused_losses(*leaves, truth, mask, region, WEIGHTS)
        terms["loss"].backward()
        results.append((terms, [leaf.grad for leaf in leaves]))
    assert results[0][0] == results[1][0]
    for full, low in zip(results[0][1], results[1][1], strict=True):
        assert low.dtype == torch.float32
        assert 0 <= float((full - low).norm() / full.norm()) < 0.01
    assert not torch.equal(results[0][1][1], results[1][1][1])
