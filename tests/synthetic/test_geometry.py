"""Delaunay triangulation."""

import numpy as np
import pytest

from facediff.synthetic.geometry import delaunay


def test_delaunay_circles_are_empty() -> None:
    points = np.random.default_rng(0).uniform(0.0, 100.0, (60, 2)).round(2)
    triangles = delaunay(points)
    for a, b, c in points[triangles]:
        first, second = b - a, c - a
        assert first[0] * second[1] - first[1] * second[0] > 0
        centre = np.linalg.solve(2.0 * np.array([first, second]), [first @ first, second @ second])
        away = np.linalg.norm(points - a - centre, axis=1)
        assert away.min() > np.linalg.norm(centre) - 0.05


def test_delaunay_refuses_what_it_cannot_do_exactly() -> None:
    with pytest.raises(ValueError, match="spread"):
        delaunay(np.array([[0.0, 0.0], [1000.0, 0.0], [0.0, 1000.0]]))
