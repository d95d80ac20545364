"""The opening of the mouth: pairs, offsets against absolute vertices, closures in every form."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from facediff.metrics import (
    BilabialClosureRate,
    LipPairs,
    MouthOpeningDifference,
    bilabial_closure_rate,
    mouth_opening_difference,
)

Anything = Any  # right and wrong closures and pairs


def mouth(openings: list[float]) -> torch.Tensor:
    """Two vertices that are so far apart."""
    motion = torch.zeros(len(openings), 2, 3)
    motion[:, 0, 1] = torch.tensor(openings)
    return motion


def test_the_opening_is_a_mean_over_pairs_and_the_difference_has_no_sign() -> None:
    truth, prediction = torch.zeros(2, 4, 3), torch.zeros(2, 4, 3)
    truth[:, 0, 0], truth[:, 2, 1] = 3.0, 1.0
    prediction[0, 0, 0], prediction[1, 2, 2] = 8.0, 2.0
    # openings of the truth 2 and 2, of the prediction 4 and 1
    assert mouth_opening_difference(prediction, truth, [(0, 1), (2, 3)]).item() == 1.5


def test_offsets_without_their_neutral_vertices_give_another_number() -> None:
    neutral = mouth([1.0])[0]
    truth, prediction = mouth([0.0, 0.5]), mouth([0.5, -0.5])
    right = mouth_opening_difference(prediction, truth, [(0, 1)], offsets_from=neutral)
    assert right == mouth_opening_difference(prediction + neutral, truth + neutral, [(0, 1)])
    assert right.item() == pytest.approx(0.75)
    assert mouth_opening_difference(prediction, truth, [(0, 1)]).item() == pytest.approx(0.25)


def test_a_neutral_face_that_does_not_fit_is_refused() -> None:
    metric = MouthOpeningDifference([(0, 1)])
    with pytest.raises(ValueError, match=r"offsets_from has shape \(3, 3\); expected"):
        metric.update(mouth([0.0]), mouth([0.0]), offsets_from=torch.zeros(3, 3))
    with pytest.raises(ValueError, match="index 2, a mesh of 2 vertices ends at 1"):
        MouthOpeningDifference([(0, 2)]).update(mouth([0.0]), mouth([0.0]))
    with pytest.raises(TypeError):
        metric.update(mouth([0.0]), mouth([0.0]), template=torch.zeros(2, 3))


def test_closed_is_a_share_of_the_range_of_the_truth() -> None:
    truth = mouth([0.1, 1.1, 0.1, 0.6, 1.1])
    prediction = mouth([0.3, 0.0, 0.31, 0.1, 0.2])
    rate = bilabial_closure_rate(prediction, truth, [(0, 1)], [(0, 1), (2, 4)], threshold=0.205)
    assert rate.item() == pytest.approx(2 / 3)  # up to 0.305: frames 0 and 3 of 0, 2, 3
    assert bilabial_closure_rate(prediction, truth, [(0, 1)], [(2, 4)], count="closures").item() == 1.0
    assert bilabial_closure_rate(prediction, truth, [(0, 1)], [(2, 4)], of="truth").item() == 0.5
    assert bilabial_closure_rate(prediction, truth, [(0, 1)], [(2, 3)], of="gap").item() == -1.0
    moved = bilabial_closure_rate(prediction * 7, truth * 7, [(0, 1)], [(0, 1), (2, 4)], threshold=0.205)
    assert moved == rate


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


@pytest.mark.parametrize(
    ("closures", "message"),
    [
        (None, "closures= is missing"),
        ([[(0, 2)]], "closures of 1 sequences for 2"),
        ([[(0, 2)], [(3, 3)]], r"closures of M3 hold the interval \(3, 3\)"),
        ([[(0, 2)], [(3, 5), (4, 6)]], r"closures of M3 hold the interval \(4, 6\).*without overlap"),
        ([[(-1, 2)], []], r"closures of F2 hold the interval \(-1, 2\)"),
        ([[(0.5, 2)], []], "closures of F2 must be a list of pairs of whole numbers"),
        ([[(0, 1, 2)], []], "closures of F2 must be a list of pairs"),
        ([0, 1], "closures of F2 must be a list of pairs"),
        (torch.ones(2, 5), "must be a boolean mask of shape"),
        (torch.ones(2, 4, dtype=torch.bool), "must be a boolean mask of shape"),
    ],
)
def test_closures_that_do_not_fit_are_refused(closures: Anything, message: str) -> None:
    metric = BilabialClosureRate([(0, 1)])
    both = torch.stack([mouth([0.0] * 5)] * 2)
    with pytest.raises(ValueError, match=message):
        metric.update(both, both, closures=closures, clip_names=["F2", "M3"])
    assert metric.coverage().sequences == 0


def test_options_out_of_range_are_refused() -> None:
    with pytest.raises(ValueError, match="threshold is 1.5; expected a share"):
        BilabialClosureRate([(0, 1)], threshold=1.5)
    with pytest.raises(ValueError, match='unknown count .frame.: .*did you mean "frames"'):
        BilabialClosureRate([(0, 1)], count="frame")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unknown of"):
        BilabialClosureRate([(0, 1)], of="both")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="unknown pooling"):
        MouthOpeningDifference([(0, 1)], pooling="frame")  # type: ignore[arg-type]


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


@pytest.mark.parametrize(
    ("pairs", "message"),
    [
        ([], "are empty"),
        ([(1, 1)], "pair vertex 1 with itself"),
        ([(-1, 1)], "hold the index -1"),
        ([(1, 2, 3)], "pairs of two whole numbers"),
        ([(1.0, 2.0)], "pairs of two whole numbers"),
        (torch.tensor([[True, False]]), "pairs of two whole numbers"),
    ],
)
def test_pairs_that_are_none_are_refused(pairs: Anything, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LipPairs.from_pairs("lips", pairs)


def test_files_of_pairs_are_named_in_errors(tmp_path: Path) -> None:
    path = tmp_path / "lips.txt"
    for content, message in (("1,2,3", "holds 3 indices, an odd number"), ("1,x", "entry 2 is 'x'"), ("4,4", "itself")):
        path.write_text(content)
        with pytest.raises(ValueError, match=message) as caught:
            LipPairs.from_file(path)
        assert str(path) in str(caught.value)
    with pytest.raises(ValueError, match="not sorted and distinct"):
        LipPairs("lips", ((2, 9), (1, 3)))


def test_a_closure_rate_says_over_what_it_is_taken() -> None:
    """Frames that are counted alike, and sequences that are, give different numbers and different words."""
    said = {}
    for pooling, count in (("frames", "frames"), ("sequences", "frames"), ("frames", "closures")):
        said[pooling, count] = BilabialClosureRate([(0, 1)], pooling=pooling, count=count, threshold=0.3).describe()  # type: ignore[arg-type]
    assert "over all sequences [1]" in said["frames", "frames"]
    assert "over each sequence, then mean over sequences [1]" in said["sequences", "frames"]
    assert "the frames of known closures" in said["frames", "frames"]
    assert "the known closures in which" in said["frames", "closures"]
    assert all("plus 0.3 of its range" in words for words in said.values())
