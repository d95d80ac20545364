"""Numbers at vertices as colours: error heat maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.render.canvas import opencv
from facediff.render.text import draw_text

HEAT_MAP = "cividis"
"""Name of the colour map, in OpenCV and matplotlib alike; its lightness grows evenly and it reads the same to those who
cannot tell red from green (Nuñez, Anderton and Renslow 2018)."""


def heat_ramp() -> npt.NDArray[np.uint8]:
    """The colour map from lowest to highest as sRGB (256, 3)."""
    cv2 = opencv()
    levels = np.arange(256, dtype=np.uint8)[:, None]
    ramp: npt.NDArray[np.uint8] = cv2.applyColorMap(levels, cv2.COLORMAP_CIVIDIS)[:, 0, ::-1]
    return np.ascontiguousarray(ramp)


def heat_colours(values: npt.NDArray[np.floating], highest: float, lowest: float = 0.0) -> npt.NDArray[np.uint8]:
    """Colours of values, those outside the scale taking the colour of its nearer end.

    Args:
        values: numbers of any shape, such as distances (V,) or (T, V).
        highest: value of the last colour.
        lowest: value of the first colour.

    Returns:
        sRGB, of the values' shape and one axis of 3 more.

    Raises:
        FaceDiffError: if the scale has no extent or a value is not finite.
    """
    if not highest > lowest:
        raise FaceDiffError(f"a colour scale from {lowest} to {highest} has no extent: give a highest above the lowest")
    if not np.isfinite(values).all():
        raise FaceDiffError("a heat map of NaN or infinity cannot be drawn: check where the values come from")
    levels = np.rint((np.asarray(values, np.float64) - lowest) * (255 / (highest - lowest)))
    return heat_ramp()[np.clip(levels, 0, 255).astype(np.uint8)]


def heat_key(
    ground: npt.NDArray[np.uint8], lowest: str, highest: str, *, colour: tuple[int, int, int]
) -> npt.NDArray[np.uint8]:
    """A copy of a picture with the colour map as a bar in its middle, its ends named.

    Args:
        ground: (height, width, 3), what the bar is drawn upon.
        lowest: text left of the bar.
        highest: text right of it.
        colour: of the letters, sRGB, 0 to 255.
    """
    height, width, _ = ground.shape
    left, right = round(0.25 * width), round(0.7 * width)
    top, bottom = round(0.3 * height), max(round(0.7 * height), round(0.3 * height) + 1)
    key = ground.copy()
    levels = np.rint(np.linspace(0, 255, right - left)).astype(np.uint8)
    key[top:bottom, left:right] = heat_ramp()[levels]
    for text, start, end in ((lowest, 2 * left - right // 2, left), (highest, right, width)):
        start = max(start, 0)
        key[:, start:end] = draw_text(key[:, start:end], text, colour=colour, scale=0.5)
    return key
