"""Pictures by which a result is looked at: faces beside one another, and numbers at vertices as colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.takes import Take


@dataclass(frozen=True)
class Panel:
    """A face to draw.

    Attributes:
        label: what stands above.
        vertices: (V, 3), y up, z to the viewer.
        faces: (F, 3).
        colours: (V, 3) sRGB; None for plain material.
    """

    label: str
    vertices: npt.NDArray[np.floating]
    faces: npt.NDArray[np.integer]
    colours: npt.NDArray[np.uint8] | None = None


def check_picture_path(path: Path | None) -> None:
    """Refuse, before any work is done, a picture that could not be written.

    Raises:
        FaceDiffError: if the suffix is not .png or the folder cannot be written.
    """
    from facediff.files import check_writable

    if path is None:
        return
    if path.suffix != ".png":
        raise FaceDiffError(f'--show {path}: unknown suffix "{path.suffix}"; expected a picture .png')
    check_writable(path)


def write_panels(path: Path, panels: Sequence[Panel], size: int = 272) -> None:
    """Draw faces of one unit beside one another at one scale."""
    from facediff.render import Camera, Renderer, contact_sheet, save_image

    camera = Camera.framing([panel.vertices for panel in panels])
    drawn = [
        Renderer(panel.faces, template=panel.vertices, size=size, camera=camera, colours=panel.colours).render(
            panel.vertices
        )
        for panel in panels
    ]
    save_image(path, contact_sheet(drawn, len(drawn), labels=[panel.label for panel in panels]))


def heat(values_mm: npt.NDArray[np.floating], label: str) -> tuple[str, npt.NDArray[np.uint8]]:
    """A label that tells the scale, and the colours of numbers at vertices (V,) from 0 to their greatest."""
    from facediff.render import heat_colours

    highest = max(float(values_mm.max()), 1e-6)
    return f"{label}, 0 to {highest:.2g} mm", heat_colours(values_mm, highest)


def widest_frame(take: Take) -> int:
    """The frame in which the mouth is most open; without known lips, that which is furthest from the neutral face."""
    import numpy as np

    best, found = -1.0, 0
    pairs = take.inner_lip_pairs
    for index, frame in enumerate(take.vertices):
        if pairs is not None and len(pairs):
            value = float(np.linalg.norm(frame[pairs[:, 0]] - frame[pairs[:, 1]], axis=1).mean())
        else:
            value = float(np.square(frame - take.template).sum())
        if value > best:
            best, found = value, index
    return found
