"""Truth, prediction and error next to each other."""

from __future__ import annotations

import matplotlib
import numpy as np
import pytest

from facediff.render import Renderer, comparison
from facediff.render.panels import heat_ramp

# An octahedron.
VERTICES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float)
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
TRUTH = np.tile(VERTICES, (3, 1, 1))
OFF = TRUTH.copy()
OFF[1, 4, 2] += 0.3  # one vertex of one frame, towards the viewer
OFF[2, 4] += [0.3, 0, 0.4]


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(FACES, template=VERTICES, size=(96, 80))


def test_comparison_shows_truth_prediction_and_coloured_prediction(renderer: Renderer) -> None:
    frames = list(comparison(renderer, TRUTH, OFF, highest=0.5, scale_label="5 mm", footer="clip"))
    assert len(frames) == 3
    top = next(row for row in range(96) if (frames[0][row : row + 96, :80] == renderer.render(VERTICES)).all())
    ramp = np.array([matplotlib.colormaps["cividis"](share)[:3] for share in (0.0, 0.6, 1.0)])
    for index, hottest in enumerate(ramp):
        colours = np.tile(ramp[0], (6, 1))
        colours[4] = hottest
        panels = frames[index][top : top + 96]
        np.testing.assert_array_equal(panels[:, :80], renderer.render(TRUTH[index]))
        np.testing.assert_array_equal(panels[:, 80:160], renderer.render(OFF[index]))
        # OpenCV's colour map and matplotlib's differ by rounding.
        np.testing.assert_allclose(panels[:, 160:].astype(int), renderer.render(OFF[index], colours=colours), atol=4)


def test_the_ramp_is_cividis_throughout() -> None:
    expected = 255 * matplotlib.colormaps["cividis"](np.arange(256))[:, :3]
    assert np.abs(heat_ramp() - expected).max() < 12  # of 255, in the darkest blue, where cividis has a kink
