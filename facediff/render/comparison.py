"""Truth, prediction and where they differ, next to each other."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.render.heat import heat_colours, heat_key
from facediff.render.panels import INK, Frame, check_motion, side_by_side
from facediff.render.rasteriser import Renderer
from facediff.render.text import draw_text

_KEY_SHARE = 0.085
_MIN_KEY = 20


def comparison(
    renderer: Renderer,
    truth: npt.NDArray[np.floating],
    prediction: npt.NDArray[np.floating],
    *,
    highest: float,
    scale_label: str,
    labels: tuple[str, str, str] = ("truth", "facediff", "error"),
    footer: str = "",
) -> Iterator[Frame]:
    """Frames of the truth, the prediction, and the prediction coloured by each vertex's distance from the truth.

    Everything is checked before the first frame is drawn.

    Args:
        renderer: draws all three panels.
        truth: absolute positions (T, V, 3).
        prediction: absolute positions (T, V, 3), in the truth's unit.
        highest: distance that gets the last colour, in the motions' unit; equal scales make pictures comparable.
        scale_label: how ``highest`` is written at the colour scale, such as "5 mm".
        labels: texts above the three panels.
        footer: text under the first two panels.

    Returns:
        A generator of T pictures, three panels wide, with strips above and below them.

    Raises:
        FaceDiffError: if the motions cannot be drawn or differ in length, or the scale has no extent.
    """
    for motion, label in zip((truth, prediction), labels, strict=False):
        check_motion(motion, renderer.n_vertices, label)
    if len(truth) != len(prediction):
        raise FaceDiffError(
            f'"{labels[0]}" has {len(truth)} frames and "{labels[1]}" {len(prediction)}: cut them to one length.'
        )
    errors = np.linalg.norm(np.asarray(prediction) - np.asarray(truth), axis=2)
    heat = heat_colours(errors, highest)
    frames = side_by_side(renderer, [truth, prediction, prediction], labels, colours=[None, None, heat])
    ground = renderer.backdrop[-1:]
    height = max(round(_KEY_SHARE * renderer.height / 2) * 2, _MIN_KEY)
    strip = np.repeat(np.hstack([ground, ground]), height, axis=0)
    strip = draw_text(strip, footer, colour=INK, scale=0.5)
    key = heat_key(np.repeat(ground, height, axis=0), "0", scale_label, colour=INK)
    foot = np.hstack([strip, key])
    return (np.concatenate([frame, foot]) for frame in frames)
