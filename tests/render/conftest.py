"""A small analytic mesh for the tests of rendering."""

from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import pytest

MakeSphere = Callable[..., tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]]


def _sphere(rows: int = 24, columns: int = 48) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
    """Unit sphere: vertices (V, 3) with one vertex at each pole, faces counter-clockwise from outside."""
    polar = np.linspace(0, np.pi, rows + 2)[1:-1]
    around = np.linspace(0, 2 * np.pi, columns, endpoint=False)
    ring = np.stack(
        [
            np.outer(np.sin(polar), np.sin(around)),
            np.outer(np.cos(polar), np.ones(columns)),
            np.outer(np.sin(polar), np.cos(around)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([ring, [[0, 1, 0], [0, -1, 0]]])
    i, j = (grid.ravel() for grid in np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij"))
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    k = np.arange(columns)
    top = np.stack([k, (k + 1) % columns, np.full(columns, rows * columns)], axis=1)
    last = (rows - 1) * columns
    bottom = np.stack([last + (k + 1) % columns, last + k, np.full(columns, rows * columns + 1)], axis=1)
    sides = [np.stack([a, c, b], axis=1), np.stack([b, c, d], axis=1)]
    return vertices, np.concatenate([*sides, top, bottom]).astype(np.int32)


@pytest.fixture(scope="session")
def sphere() -> MakeSphere:
    """The function that makes spheres of any fineness."""
    return _sphere
