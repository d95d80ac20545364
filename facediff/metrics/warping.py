"""Dynamic time warping: the cheapest way to lay two series upon one another without going back in time."""

from __future__ import annotations

import torch
from torch import Tensor

Path = list[tuple[int, int]]


def warp(distances: Tensor) -> tuple[float, Path]:
    """The cheapest warping path from the first pair of frames to the last.

    A path goes from (i, j) to (i + 1, j + 1), (i + 1, j) or (i, j + 1), and costs the sum of the distances of
    its pairs, both ends included (Sakoe and Chiba 1978, without slope weights or a band). Where ways cost the
    same, the path comes diagonally if it can, else from (i − 1, j).

    Time is O(rows · columns), vectorised along anti-diagonals, whose cells do not depend on one another: about
    50 ms for two series of 600 frames on a CPU, to which the distances are moved.

    Args:
        distances: (rows, columns), not negative, finite.

    Returns:
        The cost, and the path as pairs of row and column.

    >>> warp(torch.tensor([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0]]))
    (1.0, [(0, 0), (1, 0), (2, 1)])
    """
    rows, columns = distances.shape
    skewed = _skew(distances.detach().double().cpu())
    # Row k + 2 holds the costs of anti-diagonal k, i + j = k, at column i + 1; what lies outside costs infinity.
    costs = torch.full((rows + columns + 1, rows + 1), torch.inf, dtype=torch.float64)
    costs[0, 0] = 0.0  # where the first pair comes from
    for diagonal in range(rows + columns - 1):
        before, last = costs[diagonal], costs[diagonal + 1]
        best = torch.minimum(before[:-1], torch.minimum(last[:-1], last[1:]))
        torch.add(best, skewed[diagonal], out=costs[diagonal + 2, 1:])
    return costs[-1, -1].item(), _trace(costs, rows, columns)


def _skew(distances: Tensor) -> Tensor:
    """(rows + columns − 1, rows): row k holds the pairs with i + j = k, infinity where there is none."""
    rows, columns = distances.shape
    padded = torch.full((rows, columns + rows), torch.inf, dtype=distances.dtype)
    padded[:, :columns] = distances
    # Read with rows one shorter than they are, each row begins one further to the right than the one before.
    width = rows + columns - 1
    return padded.flatten()[: rows * width].view(rows, width).T.contiguous()


def _trace(costs: Tensor, rows: int, columns: int) -> Path:
    """The path that leads to the last pair, from the costs by anti-diagonal."""
    both, one = costs[:-2, :-1], costs[1:-1, :-1]
    other = costs[1:-1, 1:]
    diagonally = (both <= one) & (both <= other)
    steps = torch.where(diagonally, 0, torch.where(one <= other, 1, 2)).tolist()
    row, column = rows - 1, columns - 1
    path = [(row, column)]
    while row or column:
        step = steps[row + column][row]
        row, column = row - (step != 2), column - (step != 1)
        path.append((row, column))
    return path[::-1]
