"""Several motions next to each other with labels, and sheets of pictures."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.files import atomic
from facediff.render.rasteriser import Renderer
from facediff.render.text import draw_text

Frame = npt.NDArray[np.uint8]

INK = (52, 56, 66)
_FAINT = (104, 110, 122)


def side_by_side(
    renderers: Renderer | Sequence[Renderer],
    motions: Sequence[npt.NDArray[np.floating]],
    labels: Sequence[str],
    *,
    colours: Sequence[npt.NDArray[np.generic] | None] | None = None,
    footer: str | None = None,
) -> Iterator[Frame]:
    """Frames that show several motions in step, from left to right.

    Everything is checked before the first frame is drawn.

    Args:
        renderers: one for all motions (the same camera for all), or one per motion where topologies differ;
            give those one camera (`Camera.framing` of all templates) if they share a unit.
        motions: per panel absolute positions (T, V, 3); all of one length.
        labels: per panel a short text, such as "truth".
        colours: per panel sRGB (V, 3) or (T, V, 3), or None for the renderer's own.
        footer: text under all panels, such as "synthetic corpus".

    Returns:
        A generator of T pictures as wide as all panels; strips for labels above and footer below add height.
    """
    if not motions or len(labels) != len(motions):
        raise FaceDiffError(f"{len(motions)} motions and {len(labels)} labels: give a label for each.")
    drawers = [renderers] * len(motions) if isinstance(renderers, Renderer) else list(renderers)
    if len(drawers) != len(motions):
        raise FaceDiffError(f"{len(motions)} motions but {len(drawers)} renderers: give one or one each.")
    if len({drawer.height for drawer in drawers}) > 1:
        raise FaceDiffError("the renderers' pictures differ in height: make them with one size.")
    tints = list(colours) if colours is not None else [None] * len(motions)
    if len(tints) != len(motions):
        raise FaceDiffError(f"{len(motions)} motions but {len(tints)} colours: give one (or None) for each.")
    for drawer, motion, label, tint in zip(drawers, motions, labels, tints, strict=True):
        check_motion(motion, drawer.n_vertices, label)
        if tint is not None and np.shape(tint) not in (np.shape(motion), np.shape(motion)[1:]):
            raise FaceDiffError(f'colours of "{label}" have the shape {np.shape(tint)}: not (V, 3) or (T, V, 3).')
    lengths = {label: len(motion) for label, motion in zip(labels, motions, strict=True)}
    if len({len(motion) for motion in motions}) > 1:
        told = ", ".join(f'"{label}" {length}' for label, length in lengths.items())
        raise FaceDiffError(f"the motions differ in length (frames: {told}): cut them to one length.")
    return _frames(drawers, motions, labels, tints, footer)


def _frames(
    renderers: Sequence[Renderer],
    motions: Sequence[npt.NDArray[np.floating]],
    labels: Sequence[str],
    colours: Sequence[npt.NDArray[np.generic] | None],
    footer: str | None,
) -> Iterator[Frame]:
    for index in range(len(motions[0])):
        panels = []
        for renderer, motion, tint in zip(renderers, motions, colours, strict=True):
            now = tint[index] if tint is not None and np.ndim(tint) == 3 else tint
            panels.append(renderer.render(motion[index], colours=now))
        if any(label.strip() for label in labels):
            panels = [
                _caption(panel, label, "top", INK, renderer.backdrop[:1])
                for renderer, panel, label in zip(renderers, panels, labels, strict=True)
            ]
        row = np.hstack(panels)
        ground = np.hstack([renderer.backdrop[-1:] for renderer in renderers])
        yield row if not footer else _caption(row, footer, "bottom", _FAINT, ground)


def _caption(picture: Frame, text: str, edge: str, colour: tuple[int, int, int], ground: Frame | None = None) -> Frame:
    """The picture with a strip for one line of text added at an edge.

    Args:
        picture: (height, width, 3).
        text: the line.
        edge: "top" or "bottom".
        colour: of the letters, sRGB.
        ground: a row of pixels (1, width, 3) that the strip repeats, or None for white.
    """
    share = 0.085 if edge == "top" else 0.06
    height = max(round(share * picture.shape[0] / 2) * 2, 16)
    row = np.full((1, picture.shape[1], 3), 255, np.uint8) if ground is None else ground
    strip = draw_text(np.repeat(row, height, axis=0), text, colour=colour, scale=0.55)
    return np.concatenate([strip, picture] if edge == "top" else [picture, strip])


def check_motion(motion: npt.NDArray[np.floating], n_vertices: int, name: str) -> None:
    """Refuse a motion that cannot be drawn, with one sentence.

    Args:
        motion: absolute positions (T, V, 3); read frame by frame, so a memory map stays on disk.
        n_vertices: V of the template it is drawn with.
        name: what the motion is called in the message.
    """
    if motion.ndim != 3 or motion.shape[2] != 3:
        raise FaceDiffError(f'motion "{name}" must have the shape (frames, vertices, 3), got {motion.shape}.')
    if len(motion) == 0:
        raise FaceDiffError(f'motion "{name}" has no frames: there is nothing to draw.')
    if motion.shape[1] != n_vertices:
        raise FaceDiffError(
            f'motion "{name}" has {motion.shape[1]} vertices but its template has {n_vertices}: '
            "draw it with the faces and the template of its own topology."
        )
    for index, frame in enumerate(motion):
        if not np.isfinite(frame).all():
            raise FaceDiffError(f'motion "{name}" holds NaN or infinity (first in frame {index}): check its source.')


def contact_sheet(frames: Iterable[Frame], columns: int, *, labels: Sequence[str] | None = None, gap: int = 6) -> Frame:
    """Pictures of one size in rows, on white.

    Args:
        frames: pictures (height, width, 3).
        columns: pictures per row.
        labels: a text per picture, on a strip above it.
        gap: pixels between pictures.
    """
    pictures = list(frames)
    if not pictures or columns < 1:
        raise FaceDiffError(f"contact sheet of {len(pictures)} frames in {columns} columns: give at least one of each.")
    if len({picture.shape for picture in pictures}) > 1:
        raise FaceDiffError("the frames of a contact sheet differ in size: draw them with one size.")
    if labels is not None:
        if len(labels) != len(pictures):
            raise FaceDiffError(f"contact sheet of {len(pictures)} frames has {len(labels)} labels: give one for each.")
        pictures = [_caption(picture, label, "top", INK) for picture, label in zip(pictures, labels, strict=True)]
    height, width, _ = pictures[0].shape
    columns = min(columns, len(pictures))
    rows = -(-len(pictures) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, 3), 255, np.uint8)
    for index, picture in enumerate(pictures):
        top, left = index // columns * (height + gap), index % columns * (width + gap)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def save_image(path: str | Path, image: Frame) -> None:
    """Write a picture (height, width, 3) as PNG; it appears under its name only when complete."""
    from facediff.render.text import pillow

    target = Path(path)
    if target.suffix.lower() != ".png":
        raise FaceDiffError(f'picture file "{target}" must end in .png.')
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(f"image must be uint8 (height, width, 3), got {image.dtype} {image.shape}")
    picture = pillow("Image").fromarray(image)
    with atomic(target) as temporary:
        picture.save(temporary)
