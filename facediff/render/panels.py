"""Pictures made of pictures: motions side by side with labels, error heat maps, sheets, and words on them."""

from __future__ import annotations

import importlib.util
import multiprocessing
import unicodedata
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from functools import cache, lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, needs_extra
from facediff.render.rasteriser import Renderer
from facediff.utils.files import atomic
from facediff.utils.workers import processors

Frame = npt.NDArray[np.uint8]
Motion = npt.NDArray[np.floating]

INK = (52, 56, 66)
FAINT_INK = (104, 110, 122)
CIVIDIS = (
    "00224e 002e6a 1a386f 32436d 434e6c 535a6d 61656f 6f7073 7d7c78 "
    "8b8778 9a9376 aaa073 bbad6d ccba64 ddc858 efd748 fee838"
)
"""Seventeen colours of :func:`heat_ramp`, at equal steps."""
GAP = 6  # Pixels between the pictures of a sheet
MOST_THREADS = 8  # An encoder takes pictures one by one, and more than these would wait for it


def side_by_side(
    renderers: Renderer | Sequence[Renderer],
    motions: Sequence[Motion],
    labels: Sequence[str],
    *,
    colours: Sequence[npt.NDArray[np.generic] | None] | None = None,
    footer: str | None = None,
) -> Iterator[Frame]:
    """Frames that show several motions in step, from left to right.

    Args:
        renderers: one for all motions (the same camera for all), or one per motion where topologies differ; give those
            one camera (`Camera.framing` of all templates) if they share a unit.
        motions: per panel absolute positions (T, V, 3); all of one length.
        labels: per panel a short text, such as "truth".
        colours: per panel sRGB (V, 3) or (T, V, 3), or None for the renderer's own.
        footer: text under all panels, such as "synthetic corpus".

    Returns:
        A generator of T pictures, drawn in several threads. They are as wide as all panels; strips for labels above
        and footer below add height.
    """
    drawers = [renderers] * len(motions) if isinstance(renderers, Renderer) else list(renderers)
    tints = list(colours) if colours is not None else [None] * len(motions)
    # One in a process that is itself one of several workers.
    threads = 1 if multiprocessing.parent_process() is not None else min(processors(), MOST_THREADS)
    (count,) = {len(motion) for motion in motions}
    threads = min(threads, count)
    # A renderer draws one picture at a time: each thread takes a set of them and gives it back.
    idle_sets = [drawers, *([renderer.twin() for renderer in drawers] for _ in range(threads - 1))]
    labelled = any(text.strip() for text in labels)

    def draw(index: int) -> Frame:
        set_of_renderers = idle_sets.pop()
        panels = []
        for renderer, motion, label, tint in zip(set_of_renderers, motions, labels, tints, strict=True):
            frame_tint = tint[index] if tint is not None and np.ndim(tint) == 3 else tint
            panel = renderer.render(motion[index], colours=frame_tint)
            panels.append(_caption(panel, label, "top", INK, renderer.backdrop[:1]) if labelled else panel)
        idle_sets.append(set_of_renderers)
        row = np.hstack(panels)
        return row if not footer else _caption(row, footer, "bottom", FAINT_INK)

    return _in_order(draw, count, threads)


def _in_order(draw: Callable[[int], Frame], count: int, threads: int) -> Iterator[Frame]:
    """`draw` of 0, 1, 2 …; few pictures wait, however slowly they are taken."""
    if threads <= 1:
        yield from map(draw, range(count))
        return
    coming: deque[Future[Frame]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="drawing") as pool:
        try:
            for index in range(count):
                coming.append(pool.submit(draw, index))
                if len(coming) > threads:
                    yield coming.popleft().result()
            while coming:
                yield coming.popleft().result()
        finally:
            for picture in coming:
                picture.cancel()


def comparison(
    renderer: Renderer,
    truth: Motion,
    prediction: Motion,
    *,
    highest: float,
    scale_label: str,
    footer: str = "",
) -> Iterator[Frame]:
    """Frames of the truth, the prediction, and the prediction coloured by each vertex's distance from the truth.

    Args:
        renderer: draws all three panels.
        truth: absolute positions (T, V, 3).
        prediction: absolute positions (T, V, 3), in the truth's unit.
        highest: distance that gets the last colour, in the motions' unit; equal scales make pictures comparable.
        scale_label: how ``highest`` is written at the colour scale, such as "5 mm".
        footer: text under the first two panels.

    Returns:
        A generator of T pictures, three panels wide, with strips above and below them.
    """
    heat = heat_colours(np.linalg.norm(np.asarray(prediction) - np.asarray(truth), axis=2), highest)
    labels = ("truth", "facediff", "error")
    frames = side_by_side(renderer, [truth, prediction, prediction], labels, colours=[None, None, heat])
    ground = renderer.backdrop[-1:]
    height = max(round(0.085 * renderer.height / 2) * 2, 20)
    strip = draw_text(np.repeat(np.hstack([ground, ground]), height, axis=0), footer, colour=INK, scale=0.5)
    key = _heat_key(np.repeat(ground, height, axis=0), scale_label)
    foot = np.hstack([strip, key])
    return (np.concatenate([frame, foot]) for frame in frames)


def heat_ramp() -> Frame:
    """The colour map of heat maps, from lowest to highest, as sRGB (256, 3).

    It is cividis (Nuñez, Anderton and Renslow 2018): its lightness grows evenly, and it reads the same to people who
    cannot tell red from green. It is linear between 17 of its colours, so that a page needs no OpenCV for it.
    """
    colours = np.frombuffer(bytes.fromhex(CIVIDIS), np.uint8).reshape(-1, 3)
    positions = np.linspace(0, 255, len(colours))
    ramp = [np.interp(np.arange(256), positions, channel) for channel in colours.T.astype(float)]
    return np.rint(np.stack(ramp, axis=1)).astype(np.uint8)


def heat_colours(values: npt.NDArray[np.floating], highest: float) -> Frame:
    """Colours (…, 3), sRGB, of values (…) from 0 to ``highest``; those outside get the colour of the nearer end."""
    if not (highest > 0 and np.isfinite(values).all()):
        raise FaceDiffError(f"a heat map from 0 to {highest} has no extent, or its values are not finite")
    levels = np.rint(np.asarray(values, np.float64) * (255 / highest))
    return heat_ramp()[np.clip(levels, 0, 255).astype(np.uint8)]


def _heat_key(ground: Frame, highest: str) -> Frame:
    """A copy of a picture (height, width, 3) with the colour map as a bar in its middle, its ends named."""
    height, width, _ = ground.shape
    left, right = round(0.25 * width), round(0.7 * width)
    top, bottom = round(0.3 * height), max(round(0.7 * height), round(0.3 * height) + 1)
    key = ground.copy()
    levels = np.rint(np.linspace(0, 255, right - left)).astype(np.uint8)
    key[top:bottom, left:right] = heat_ramp()[levels]
    for text, start, end in (("0", max(2 * left - right // 2, 0), left), (highest, right, width)):
        key[:, start:end] = draw_text(key[:, start:end], text, colour=INK, scale=0.5)
    return key


def contact_sheet(frames: Iterable[Frame], columns: int, *, labels: Sequence[str] | None = None) -> Frame:
    """Pictures (height, width, 3) of one size in rows, on white, each with its label on a strip above it."""
    pictures = list(frames)
    if labels is not None:
        pictures = [_caption(picture, label, "top", INK) for picture, label in zip(pictures, labels, strict=True)]
    height, width, _ = pictures[0].shape
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + GAP) - GAP, columns * (width + GAP) - GAP, 3), 255, np.uint8)
    for index, picture in enumerate(pictures):
        top, left = index // columns * (height + GAP), index % columns * (width + GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def save_image(path: str | Path, image: Frame) -> None:
    """Write a picture (height, width, 3) as PNG; it appears under its name only when complete."""
    picture = _pillow("Image").fromarray(image)
    with atomic(Path(path)) as temporary:
        picture.save(temporary)


def _caption(picture: Frame, text: str, edge: str, colour: tuple[int, int, int], ground: Frame | None = None) -> Frame:
    """The picture with a strip for one line of text added at its "top" or "bottom" edge.

    The strip repeats ``ground``, a row of pixels (1, width, 3); it is white without one.
    """
    share = 0.085 if edge == "top" else 0.06
    height = max(round(share * picture.shape[0] / 2) * 2, 16)
    row = np.full((1, picture.shape[1], 3), 255, np.uint8) if ground is None else ground
    strip = draw_text(np.repeat(row, height, axis=0), text, colour=colour, scale=0.55)
    return np.concatenate([strip, picture] if edge == "top" else [picture, strip])


def draw_text(picture: Frame, text: str, *, colour: tuple[int, int, int], scale: float) -> Frame:
    """A copy of the picture (height, width, 3) with a line of text in its middle.

    Letters are ``scale`` times as high as the picture, and smaller where the line would be wider than it.
    """
    text = " ".join(text.split())  # no layout has line breaks, which names of files may have
    if not text:
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
    image, draw, fonts = _pillow("Image"), _pillow("ImageDraw"), _pillow("ImageFont")
    wide = None if text.isascii() else _wide_font()
    if wide is None:  # Pillow's own font has boxes for all but ASCII: an e is nearer to an é
        text = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode()
    while True:
        font = fonts.load_default(size=points) if wide is None else fonts.truetype(wide, points)
        left, _, right, _ = font.getbbox(text)
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


@cache
def _wide_font() -> str | None:
    """A font with the letters of many languages, of matplotlib or of the system; None if there is none."""
    library = importlib.util.find_spec("matplotlib")
    bundled = (
        [str(Path(library.origin).parent / "mpl-data/fonts/ttf/DejaVuSans.ttf")] if library and library.origin else []
    )
    for name in (*bundled, "DejaVuSans.ttf", "NotoSans-Regular.ttf", "Arial.ttf", "arial.ttf"):
        with suppress(OSError):
            _pillow("ImageFont").truetype(name, 12)
            return name
    return None


def _pillow(module: str) -> Any:  # noqa: ANN401 - imported on first use
    """A module of Pillow."""
    with needs_extra("PIL", "render", "writing pictures and labels"):
        return importlib.import_module(f"PIL.{module}")
