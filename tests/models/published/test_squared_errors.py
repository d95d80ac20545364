"""The published squared errors in few passes, against their definition and its gradient by PyTorch."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from facediff.models.published.squared_errors import mean_squared_error, squared_errors

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


def test_of_one_clip_the_mean_is_pytorchs_own() -> None:
    predicted, truth = torch.randn(2, 1, 5, 6, generator=torch.Generator().manual_seed(0))
    found = mean_squared_error(predicted, truth, torch.tensor([5]))
    torch.testing.assert_close(found, torch.nn.functional.mse_loss(predicted, truth))
    assert mean_squared_error(predicted, truth, torch.tensor([0])) == 0
