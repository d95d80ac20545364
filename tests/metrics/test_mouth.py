"""The opening of the mouth: pairs, offsets against absolute vertices, closures in every form."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from facediff.metrics import (
    BilabialClosureRate,
    LipPairs,
    bilabial_closure_rate,
    mouth_opening_difference,
)
from facediff.metrics.mouth import speed
from facediff.metrics.one_pass import frames_per_step


def mouth(openings: list[float]) -> torch.Tensor:
    """Two vertices that are so far apart."""
    motion = torch.zeros(len(openings), 2, 3)
    motion[:, 0, 1] = torch.tensor(openings)
    return motion


def test_the_speed_of_long_motion_loses_no_step() -> None:
    """It is read a few frames at a time; NumPy's definition over all of them."""
    motion = torch.randn(150, 3000, 3, generator=torch.manual_seed(0))
    assert frames_per_step(motion, 3000) < 60
    steps = np.diff(motion.double().numpy(), axis=0)
    expected = np.linalg.norm(steps, axis=-1).mean(1)
    np.testing.assert_allclose(speed(motion, torch.arange(3000)).numpy(), expected, rtol=1e-12)


def test_a_mask_is_runs_of_closures() -> None:
    truth = torch.stack([mouth([0.0, 1.0, 1.0, 0.0, 1.0]), mouth([0.0, 0.0, 1.0, 1.0, 1.0])])
    prediction = truth.flip(1)
    mask = torch.tensor([[True, True, False, True, True], [False, False, True, True, True]])
    intervals = [[(0, 2), (3, 5)], list(np.array([[2, 5]]))]
    for options in ({}, {"count": "closures"}, {"pooling": "sequences"}, {"lengths": [5, 3]}):
        by_mask, by_interval = (
            bilabial_closure_rate(prediction, truth, [(0, 1)], closures, **options)  # type: ignore[arg-type]
            for closures in (mask, intervals)
        )
        assert by_mask == by_interval
    single = bilabial_closure_rate(prediction[0], truth[0], [(0, 1)], mask[0])
    assert single == bilabial_closure_rate(prediction[0], truth[0], [(0, 1)], intervals[0])


def test_closures_beyond_the_scored_frames_do_not_count() -> None:
    metric = BilabialClosureRate([(0, 1)])
    metric.update(mouth([0.0] * 4), mouth([0.0] * 9), closures=[(2, 6), (7, 9)])
    assert (metric.coverage().frames, metric.compute().item()) == (2, 1.0)


def test_pairs_are_sorted_distinct_and_counted_once(tmp_path: Path) -> None:
    pairs = LipPairs.from_pairs("inner", [(9, 2), (1, 3), (2, 9)])
    assert (pairs.pairs, pairs.count, pairs.duplicates) == (((1, 3), (2, 9)), 2, 1)
    assert LipPairs.from_pairs("other", torch.tensor([[3, 1], [2, 9]])).hash == pairs.hash
    assert LipPairs.from_pairs("other", np.array([[3, 1], [2, 9]])).hash == pairs.hash
    assert LipPairs.from_pairs("other", list(np.array([[3, 1], [2, 9]]))).hash == pairs.hash
    assert LipPairs.from_pairs("other", [(1, 29)]).hash != pairs.hash
    path = tmp_path / "lips.txt"
    path.write_text("9 2\n1, 3\n2,9")
    assert LipPairs.from_file(path).pairs == pairs.pairs
    assert LipPairs.from_file(path).name == "lips"
    motion = torch.randn(2, 4, 10, 3, generator=torch.manual_seed(0))
    once = mouth_opening_difference(motion[0], motion[1], [(9, 2), (1, 3)])
    assert mouth_opening_difference(motion[0], motion[1], [(9, 2), (1, 3), (2, 9)]) == once


def test_files_of_pairs_are_named_in_errors(tmp_path: Path) -> None:
    path = tmp_path / "lips.txt"
    for content in ("1,2,3", "1,x", "4,4", ""):
        path.write_text(content)
        with pytest.raises(ValueError, match=r"lips\.txt: "):
            LipPairs.from_file(path)
    for pairs in ([(1, 2, 3)], [(1.0, 2.0)], [0, 1]):
        with pytest.raises((ValueError, TypeError)):
            LipPairs.from_pairs("lips", pairs)
    with pytest.raises(ValueError, match="sorted and distinct"):
        LipPairs("lips", ((2, 9), (1, 3)))
