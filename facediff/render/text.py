"""Words on pictures, in the one font that Pillow brings with it."""

import importlib
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import MissingExtraError


def pillow(module: str) -> Any:  # noqa: ANN401 - imported on first use
    """A module of Pillow, or a sentence that says how to get it."""
    try:
        return importlib.import_module(f"PIL.{module}")
    except ImportError as error:
        raise MissingExtraError("PIL", "render", "writing pictures and labels") from error


def draw_text(
    picture: npt.NDArray[np.uint8], text: str, *, colour: tuple[int, int, int], scale: float
) -> npt.NDArray[np.uint8]:
    """A copy of the picture with a line of text in its middle.

    Args:
        picture: (height, width, 3).
        text: the line; made smaller where it is wider than the picture.
        colour: sRGB, 0 to 255.
        scale: height of the letters as a share of the picture's height.
    """
    if not text.strip():
        return picture.copy()
    height, width, _ = picture.shape
    mask = _text_mask(text, max(round(scale * height), 9), round(0.94 * width))
    rows, columns = min(mask.shape[0], height), min(mask.shape[1], width)
    top, left = (height - rows) // 2, (width - columns) // 2
    result = picture.copy()
    area = result[top : top + rows, left : left + columns]
    opacity = mask[:rows, :columns, None]
    area[:] = np.rint(area * (1 - opacity) + np.asarray(colour) * opacity).astype(np.uint8)
    return result


@lru_cache(maxsize=64)
def _text_mask(text: str, points: int, max_width: int) -> npt.NDArray[np.float32]:
    """Opacity of a line of text (rows, columns); cached, since every frame of a video has the same label."""
    image, draw, fonts = pillow("Image"), pillow("ImageDraw"), pillow("ImageFont")
    while True:
        font = fonts.load_default(size=points)
        left, top, right, bottom = font.getbbox(text)
        if right - left <= max_width or points <= 6:
            break
        points = max(6, min(points - 1, int(points * max_width / (right - left))))
    # Ascent and descent, not the box of these letters: labels side by side then share a base line.
    ascent, descent = font.getmetrics()
    canvas = image.new("L", (max(int(right - left), 1), ascent + descent))
    draw.Draw(canvas).text((-left, 0), text, font=font, fill=255)
    mask = np.asarray(canvas, dtype=np.float32) / np.float32(255)
    mask.setflags(write=False)
    return mask
