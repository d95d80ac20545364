"""What update refuses, what it cuts, and that a refused batch leaves no trace."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from facediff.errors import NotFiniteError
from facediff.metrics import (
    Clip,
    Coverage,
    FaceDynamicsDeviation,
    LipVertexError,
    MeanVertexError,
    SequenceMetric,
    face_dynamics_deviation,
    mean_vertex_error,
)


def motion(batch: int = 2, frames: int = 5, vertices: int = 4) -> torch.Tensor:
    return torch.randn(batch, frames, vertices, 3, generator=torch.manual_seed(frames))


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("side", ["prediction", "truth"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16])
@pytest.mark.parametrize("metric", [MeanVertexError(), LipVertexError([0]), FaceDynamicsDeviation([0])])
def test_nan_and_infinity_name_the_clip(metric: SequenceMetric, side: str, bad: float, dtype: torch.dtype) -> None:
    metric.reset()
    both: dict[str, Any] = {"prediction": motion().to(dtype), "truth": motion().to(dtype)}
    both[side][1, 3, 2, 0] = bad  # outside the region of two of the metrics: refused all the same
    with pytest.raises(NotFiniteError, match=rf"{side} of M3_e40 holds NaN or infinity, first in frame 3") as refused:
        metric.update(**both, clip_names=["F2_e37", "M3_e40"])
    assert isinstance(refused.value, ValueError)
    assert metric.coverage() == Coverage(0, 0, 0, 0)
    metric.update(**both, lengths=[5, 3])  # the bad frame is padding now
    assert metric.coverage() == Coverage(8, 2, 0, 0)


def test_a_sum_that_overflows_is_not_taken_for_infinity() -> None:
    huge = torch.full((1, 4, 3), 3e38)
    assert mean_vertex_error(huge, huge).item() == 0.0


def test_nan_in_a_template_names_the_clip() -> None:
    template = torch.zeros(2, 4, 3)
    template[1, 0, 0] = float("nan")
    metric = FaceDynamicsDeviation([0])
    with pytest.raises(ValueError, match="template of b holds NaN"):
        metric.update(motion(), motion(), template=template, clip_names=["a", "b"])
    with pytest.raises(ValueError, match=r"template has shape \(3, 3\)"):
        metric.update(motion(), motion(), template=template[0, :3])


def test_rule_min_cuts_both_and_reports() -> None:
    metric = MeanVertexError()
    metric.update(motion(), motion(), lengths=[5, 3], prediction_lengths=[2, 4])
    assert metric.coverage() == Coverage(frames=5, sequences=2, cut_prediction=1, cut_truth=3)
    expected = torch.cat([motion()[0, :2] * 0, motion()[1, :3] * 0]).norm(dim=-1).mean()
    assert metric.compute() == expected


def test_rule_error_refuses_any_difference() -> None:
    metric = MeanVertexError(length_rule="error")
    metric.update(motion(), motion(), lengths=[5, 3])
    for lengths in ([5, 4], [5, 2]):
        with pytest.raises(ValueError, match=r"clip 1 of the batch: the prediction has \d frames, the truth 3"):
            metric.update(motion(), motion(), lengths=[5, 3], prediction_lengths=lengths)


def test_rule_prediction_cuts_the_prediction_only() -> None:
    metric = LipVertexError([0], length_rule="prediction")
    metric.update(motion(frames=6)[:, :, :], motion(frames=4))
    assert metric.coverage() == Coverage(frames=8, sequences=2, cut_prediction=4, cut_truth=0)
    with pytest.raises(ValueError, match="the clip: the prediction has 3 frames, the truth 4.*'prediction' refuses"):
        metric.update(motion(frames=3)[0], motion(frames=4)[0])


def test_a_mask_is_a_length() -> None:
    mask = torch.arange(5) < torch.tensor([[5], [2]])
    by_mask = mean_vertex_error(motion(), motion() * 2, lengths=mask)
    assert by_mask == mean_vertex_error(motion(), motion() * 2, lengths=[5, 2])
    with pytest.raises(ValueError, match="without gaps"):
        mean_vertex_error(motion(), motion(), lengths=~mask)


def test_one_sequence_without_batch_axis() -> None:
    metric = MeanVertexError()
    metric.update(motion()[0], motion()[0], lengths=4, clip_names=["F2_e37"])
    assert metric.coverage().frames == 4


@pytest.mark.parametrize("value", [torch.ones(5, dtype=torch.float64), 1.0])
def test_a_sequence_has_one_number(value: torch.Tensor) -> None:
    """A number for each frame of a single sequence would be added up, and weigh as one."""

    class PerFrame(SequenceMetric):
        words = "distance"

        def clip_value(self, clip: Clip) -> torch.Tensor:
            return value

    metric = PerFrame()
    with pytest.raises(ValueError, match="clip_value of PerFrame gave a .*; expected a tensor of one number"):
        metric.update(motion()[0], motion()[0])
    assert metric.coverage().sequences == 0


def test_clips_of_one_frame_count_and_do_not_vary() -> None:
    assert face_dynamics_deviation(motion(frames=1), motion(frames=1) * 3, [0, 1]).item() == 0.0
    assert mean_vertex_error(motion(frames=1), motion(frames=1) * 3).item() > 0
