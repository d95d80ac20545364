"""Lengths, masks, and clips of one frame in an update."""

from __future__ import annotations

import pytest
import torch

from facediff.metrics import (
    Clip,
    Coverage,
    MeanVertexError,
    SequenceMetric,
    face_dynamics_deviation,
    mean_vertex_error,
)


def motion(batch: int = 2, frames: int = 5, vertices: int = 4) -> torch.Tensor:
    return torch.randn(batch, frames, vertices, 3, generator=torch.manual_seed(frames))


def test_a_sum_that_overflows_is_not_taken_for_infinity() -> None:
    huge = torch.full((1, 4, 3), 3e38)
    assert mean_vertex_error(huge, huge).item() == 0.0


def test_rule_min_cuts_both_and_reports() -> None:
    metric = MeanVertexError()
    metric.update(motion(), motion(), lengths=[5, 3], prediction_lengths=[2, 4])
    assert metric.coverage() == Coverage(frames=5, sequences=2, cut_prediction=1, cut_truth=3)
    expected = torch.cat([motion()[0, :2] * 0, motion()[1, :3] * 0]).norm(dim=-1).mean()
    assert metric.compute() == expected


def test_a_mask_is_a_length() -> None:
    mask = torch.arange(5) < torch.tensor([[5], [2]])
    by_mask = mean_vertex_error(motion(), motion() * 2, lengths=mask)
    assert by_mask == mean_vertex_error(motion(), motion() * 2, lengths=[5, 2])
    with pytest.raises(ValueError, match="without gaps"):
        mean_vertex_error(motion(), motion(), lengths=~mask)


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
