"""The published squared errors in few passes, against their definition and its gradient by PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from facediff.models.squared_errors import mean_squared_error, squared_errors

FRAMES = torch.tensor([7, 1, 4])


def by_definition(predicted: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Clip by clip, without padding."""
    errors = [p[:n] - t[:n] for p, t, n in zip(predicted, truth, FRAMES.tolist(), strict=True)]
    return (
        torch.stack([error.square().sum() for error in errors]).sum(),
        torch.stack([error.diff(dim=0).square().sum() for error in errors]).sum(),
    )


@pytest.mark.parametrize("padding", [0.0, 1e6, float("nan")])
@pytest.mark.parametrize("weights", [(1.0, 0.0), (0.7, 3.0)])
def test_sums_and_gradients_are_those_of_the_definition(padding: float, weights: tuple[float, float]) -> None:
    generator = torch.Generator().manual_seed(3)
    predicted, truth = torch.randn(2, 3, 8, 15, dtype=torch.float64, generator=generator)
    for clip, valid in enumerate(FRAMES.tolist()):
        predicted[clip, valid:] = padding
    ours, theirs = predicted.clone().requires_grad_(), predicted.clone().requires_grad_()
    found, expected = squared_errors(ours, truth, FRAMES), by_definition(theirs, truth)
    torch.testing.assert_close(found, expected)
    sum(weight * term for weight, term in zip(weights, found, strict=True)).backward()  # type: ignore[union-attr]
    sum(weight * term for weight, term in zip(weights, expected, strict=True)).backward()  # type: ignore[union-attr]
    torch.testing.assert_close(ours.grad, theirs.grad)


def test_columns_and_a_mask_with_gaps_choose_what_counts() -> None:
    """By the definition, frame by frame; a change counts between two valid neighbours."""
    generator = torch.Generator().manual_seed(4)
    predicted, truth = torch.randn(2, 2, 9, 6, dtype=torch.float64, generator=generator)
    mask, columns = torch.rand(2, 9, generator=generator) < 0.6, torch.tensor([1, 1, 0, 0, 1, 0], dtype=torch.bool)
    ours, theirs = predicted.clone().requires_grad_(), predicted.clone().requires_grad_()
    squares = (theirs - truth)[..., columns].square()[mask].sum()
    steps = (theirs - truth)[..., columns].diff(dim=1).square()[mask[:, 1:] & mask[:, :-1]].sum()
    found = squared_errors(ours, truth, mask, columns)
    torch.testing.assert_close(found, (squares, steps))
    (found[0] + 3 * found[1]).backward()  # type: ignore[no-untyped-call]
    (squares + 3 * steps).backward()
    torch.testing.assert_close(ours.grad, theirs.grad)


def test_half_precision_predictions_have_full_precision_errors() -> None:
    """As mixed precision has them: 4 100 errors of 1, a sum that bfloat16 cannot hold."""
    predicted = torch.ones(1, 4, 1025, dtype=torch.bfloat16, requires_grad=True)
    position, _ = squared_errors(predicted, torch.zeros(1, 4, 1025), torch.tensor([4]))
    assert position == 4100
    position.backward()  # type: ignore[no-untyped-call]
    assert predicted.grad is not None
    assert predicted.grad.dtype == torch.bfloat16


def test_of_one_clip_the_mean_is_pytorchs_own() -> None:
    predicted, truth = torch.randn(2, 1, 5, 6, generator=torch.Generator().manual_seed(0))
    found = mean_squared_error(predicted, truth, torch.tensor([5]))
    torch.testing.assert_close(found, torch.nn.functional.mse_loss(predicted, truth))
    assert mean_squared_error(predicted, truth, torch.tensor([0])) == 0
