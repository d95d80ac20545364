"""Truth, prediction and error next to each other."""

from __future__ import annotations

import cv2
import matplotlib
import numpy as np
import pytest

from facediff.errors import FaceDiffError
from facediff.render import Renderer, comparison, heat_colours
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


def test_comparison_key_shows_the_scale_and_stays_the_same(renderer: Renderer) -> None:
    one, two = (
        list(comparison(renderer, TRUTH, OFF, highest=highest, scale_label=label, footer="a clip"))
        for highest, label in ((0.5, "5 mm"), (0.1, "1 mm"))
    )
    foot = slice(-20, None)
    assert all(np.array_equal(frame[foot], one[0][foot]) for frame in one)
    ground = np.repeat(renderer.backdrop[-1:], 20, axis=0).astype(int)
    changed = [np.abs(one[0][foot, left : left + 80].astype(int) - ground).max() for left in (0, 80, 160)]
    assert min(changed) > 50  # the footer reaches over two panels, the key is under the third
    bar = one[0][-10, 160:][20:56].astype(int)
    assert (np.diff(bar.sum(axis=1)) >= 0).all()  # from dark to light, as the colour map's lightness grows
    np.testing.assert_allclose(bar[[0, -1]], heat_colours(np.array([0.0, 1.0]), 1.0), atol=4)
    assert not np.array_equal(one[0][foot], two[0][foot])
    assert cv2.absdiff(one[0][foot, :216], two[0][foot, :216]).max() == 0  # only the last number differs


def test_comparison_refuses_motions_that_cannot_be_coloured(renderer: Renderer) -> None:
    broken = OFF.copy()
    broken[2, 0, 0] = np.nan
    for truth, prediction, highest, message in (
        (TRUTH, OFF[:1], 1.0, '"truth" 3, "facediff" 1'),
        (TRUTH, broken, 1.0, "not finite"),
        (TRUTH, OFF, 0.0, "no extent"),
    ):
        with pytest.raises(FaceDiffError, match=message):
            comparison(renderer, truth, prediction, highest=highest, scale_label="")
