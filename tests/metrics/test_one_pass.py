"""Many numbers from one reading of a clip: each is what it is alone, and what the formula says."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from facediff.metrics import FaceDynamicsDeviation, LipVertexError, MeanVertexError
from facediff.metrics.one_pass import ErrorOf, one_pass

VERTICES = 5000
LIPS, UPPER, BROWS = torch.tensor([3, 7, 4000]), torch.tensor([0, 9, 10, 4999]), torch.tensor([20, 21])
ERRORS = (
    ErrorOf(None, "mean", False),
    ErrorOf(LIPS, "max", True),
    ErrorOf(None, "max", True),
    ErrorOf(LIPS, "max", False),
    ErrorOf(None, "mean", True),
    ErrorOf(UPPER, "mean", False),
)


def clip(truth_type: torch.dtype, prediction_type: torch.dtype) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Truth and prediction of more frames than are widened at a time, and a template."""
    generator = torch.manual_seed(0)
    template = torch.randn(VERTICES, 3, generator=generator)
    truth, prediction = template + 0.01 * torch.randn(2, 75, VERTICES, 3, generator=generator)
    return truth.to(truth_type), prediction.to(prediction_type), template


@pytest.mark.parametrize(
    ("truth_type", "prediction_type"),
    [(torch.float32, torch.float32), (torch.float64, torch.float32), (torch.float16, torch.float64)],
)
def test_digits_do_not_depend_on_what_else_is_asked_for(truth_type: torch.dtype, prediction_type: torch.dtype) -> None:
    truth, prediction, template = clip(truth_type, prediction_type)
    before = truth.clone(), prediction.clone()
    means, deviations = one_pass(prediction, truth, errors=ERRORS, template=template, uppers=[UPPER, BROWS])
    assert torch.equal(truth, before[0])  # buffers are written to, not what was given
    assert torch.equal(prediction, before[1])
    squares = (truth.double() - prediction.double()).square().sum(-1)
    for error, mean in zip(ERRORS, means, strict=True):
        alone = one_pass(prediction, truth, errors=[error])[0][0]
        torch.testing.assert_close(alone, mean, rtol=1e-14, atol=0)
        of_region = squares if error.indices is None else squares[:, error.indices]
        of_frames = of_region if error.squared else of_region.sqrt()
        expected = (of_frames.mean(1) if error.reduction == "mean" else of_frames.amax(1)).mean()
        torch.testing.assert_close(mean, expected, rtol=1e-13, atol=0)
    for indices, deviation in zip((UPPER, BROWS), deviations, strict=True):
        spreads = [
            (motion.double() - template.double())[:, indices].square().sum(-1).std(0, correction=0).mean()
            for motion in (truth, prediction)
        ]
        torch.testing.assert_close(deviation, spreads[0] - spreads[1], rtol=1e-10, atol=0)


@pytest.mark.parametrize("outlier", [0.0, 10.0])
def test_small_movement_far_from_the_template_keeps_its_spread(outlier: float) -> None:
    # The squared offset is 1e4 and varies by 1e-3; its plain sum of squares would leave no digit of the variance.
    generator = np.random.default_rng(0)
    motion = 100 + 1e-5 * generator.standard_normal((200, 6, 3))
    motion[0] += outlier  # the frame from which the sums are counted is unlike all others
    still = torch.full((200, 6, 3), 100.0, dtype=torch.float64)
    found = one_pass(still, torch.from_numpy(motion), template=torch.ones(6, 3), uppers=[torch.arange(6)])[1][0]
    expected = np.square(motion.astype(np.longdouble) - 1).sum(-1).std(0).mean()
    assert found.item() == pytest.approx(float(expected), rel=1e-7)
    assert one_pass(still, still, uppers=[torch.arange(6)])[1][0] == 0


def test_what_updates_leave_behind_is_each_sequence_s_own_value() -> None:
    truth, prediction = torch.randn(2, 3, 6, 8, 3, generator=torch.manual_seed(0)).unbind(0)
    for metric in (MeanVertexError(), LipVertexError([1, 2]), FaceDynamicsDeviation([0, 5])):
        assert metric.latest is None
        metric.update(prediction, truth, lengths=[6, 1, 4])
        alone = []
        for place, length in enumerate((6, 1, 4)):
            metric.reset()
            metric.update(prediction[place, :length], truth[place, :length])
            alone.append(metric.compute().item())
        metric.update(prediction, truth, lengths=[6, 1, 4])
        assert metric.latest is not None
        assert metric.latest.tolist() == alone
