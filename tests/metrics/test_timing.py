"""Dynamic time warping and the misalignment read from it."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from facediff.metrics import TemporalMisalignment, temporal_misalignment, warp
from facediff.metrics.timing import extrema, matched_lags, smooth
from tests.metrics.further_cases import cheapest_path, gaussian

few = settings(max_examples=40, deadline=None)
sizes = st.integers(1, 7)


@few
@given(sizes, sizes, st.integers(0, 2**31))
def test_ties_are_broken_as_documented(rows: int, columns: int, seed: int) -> None:
    """Small whole numbers tie all the time and add up exactly."""
    distances = torch.randint(0, 3, (rows, columns), generator=torch.manual_seed(seed)).double()
    cost, path = warp(distances)
    assert path == cheapest_path(distances.numpy())
    assert cost == sum(distances[cell].item() for cell in path)


def test_a_still_face_has_no_misalignment_unless_every_pair_counts() -> None:
    still = torch.zeros(60, 2, 3, dtype=torch.float64)
    moving = torch.rand(60, 2, 3, dtype=torch.float64, generator=torch.manual_seed(0))
    metric = TemporalMisalignment([(0, 1)])
    metric.update(still, moving)
    assert metric.coverage().left_out == 1
    with pytest.raises(ValueError, match="pairs no opening or closing"):
        metric.compute()
    assert temporal_misalignment(still, moving, [(0, 1)], at="path") >= 0


@few
@given(st.lists(st.integers(0, 3), min_size=1, max_size=30), st.sampled_from([0.1, 0.5, 2.0, 3.3]))
def test_smoothing_is_a_convolution_with_mirrored_ends(values: list[int], deviation: float) -> None:
    series = torch.tensor(values, dtype=torch.float64)
    expected = torch.from_numpy(gaussian(series.numpy(), deviation))
    torch.testing.assert_close(smooth(series, deviation), expected, rtol=1e-12, atol=1e-12)
    assert smooth(series, 0.0) is series


@few
@given(st.lists(st.integers(0, 2), min_size=1, max_size=12))
def test_extrema_are_runs_above_or_below_their_neighbours(values: list[int]) -> None:
    expected = {}
    for start, end in product(range(1, len(values)), repeat=2):
        if start <= end < len(values) - 1 and len(set(values[start : end + 1])) == 1:
            before, here, after = values[start - 1], values[start], values[end + 1]
            if before < here > after:
                expected[(start + end) // 2] = 1
            if before > here < after:
                expected[(start + end) // 2] = -1
    assert extrema([float(value) for value in values]) == expected


def test_lags_are_taken_where_both_turn_alike_and_not_beyond_a_neighbour() -> None:
    truth, prediction = [0.0, 1, 0, 1, 0, 0, 0], [0.0, 0, 1, 0, 0, 1, 0]
    # truth turns at 1 (up), 2 (down), 3 (up); prediction at 2 (up), 3 (down; of the plateau 3 to 4), 5 (up)
    assert matched_lags([(1, 2), (2, 3), (3, 5), (1, 3), (3, 4)], truth, prediction) == [1, 1, 2]
    assert matched_lags([(1, 5)], truth, prediction) == []  # beyond the truth's extremum at 2
    assert matched_lags([(0, 0), (6, 6)], truth, prediction) == []
    assert matched_lags([(0, 0)], [0.0], [0.0]) == []


def test_lags_reach_the_neighbouring_extrema_and_the_ends_themselves() -> None:
    truth = [0.0, 0, 1, 0, 1, 0, 0]  # up at 2, down at 3, up at 4; the ends are 0 and 6

    def turning(place: int, way: float) -> list[float]:
        return [way if frame == place else 0.0 for frame in range(9)]

    for row, way, reached in ((2, 1.0, {1, 2, 3}), (3, -1.0, {2, 3, 4}), (4, 1.0, {3, 4, 5, 6})):
        for column in range(1, 8):
            found = matched_lags([(row, column)], truth, turning(column, way))
            assert found == ([abs(row - column)] if column in reached else []), (row, column)
