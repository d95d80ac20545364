"""Numbers at vertices as colours: error heat maps."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.render.canvas import opencv

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
