"""Pictures of meshes for figures: on white, cut to the face, all with one camera."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.figures.material import Array
from facediff.render import EVEN, Camera, Light, Look, Renderer
from facediff.render.camera import FIELD_OF_VIEW

WHITE = (1.0, 1.0, 1.0)

SHADED = Look(lights=EVEN, background_top=WHITE, background_bottom=WHITE)
"""For faces: light from straight ahead, the same on both halves."""

FLAT = Look(
    lights=(Light((0.0, 0.25, 0.97), (0.45, 0.45, 0.45), wrap=1.0),),
    sky=(0.55, 0.55, 0.55),
    ground=(0.55, 0.55, 0.55),
    background_top=WHITE,
    background_bottom=WHITE,
)
"""For colours that stand for numbers: what faces the viewer has exactly its colour, without highlights."""

MARGIN = 0.015
"""Share of the face's size that stays free on every side, for motion that leaves the template."""

HALF = math.tan(FIELD_OF_VIEW / 2)
"""Half the extent of a camera's picture at distance 1."""

SMALLEST = 40
"""Fewest pixels of a picture that shows anything."""

AROUND_LIPS = 0.9
"""How much more than the lips a close-up shows on every side, as a share of their width."""


class Painter:
    """Draws one topology, white around, with a camera framed once on a face at rest.

    Args:
        faces: triangles (F, 3).
        shape: the face at rest (V, 3).
        view: a name in ``VIEWS``.
        look: material and lights.
        colours: sRGB (V, 3) of the surface; the look's material if None.
        region: vertices to show closely; the whole mesh if None.
    """

    def __init__(
        self,
        faces: npt.NDArray[np.int32],
        shape: Array,
        *,
        view: str = "front",
        look: Look = SHADED,
        colours: npt.NDArray[np.uint8] | None = None,
        region: Sequence[int] | None = None,
    ) -> None:
        self.faces, self.shape, self.look, self.colours = faces, shape, look, colours
        framed = shape if region is None else _box_around(shape[list(region)])
        whole, camera = Camera.framing(shape, view=view), Camera.framing(framed, view=view)
        # A close-up must not cut off the ears, which lie behind what it is framed on.
        self._camera = replace(camera, radius=max(camera.radius, whole.radius))
        points = self._camera.to_camera(framed)
        seen = points[:, :2] / -points[:, 2:]
        margin = MARGIN * np.ptp(seen, axis=0).max()
        # The camera leaves free what perspective takes from the far parts: pictures are cut to what is seen.
        self._seen = np.clip(seen.min(0) - margin, -HALF, HALF), np.clip(seen.max(0) + margin, -HALF, HALF)
        self._cut = slice(0), slice(0)
        self._renderer: Renderer | None = None

    @property
    def aspect(self) -> float:
        """Width of a picture by its height."""
        low, high = self._seen
        return float((high[0] - low[0]) / (high[1] - low[1]))

    def set_size(self, width: int, height: int) -> None:
        """Say how many pixels a picture has.

        Raises:
            FaceDiffError: if they are too few to see anything.
        """
        if min(width, height) < SMALLEST:
            raise FaceDiffError(
                f"a picture of {width} × {height} pixels shows nothing; draw fewer columns, or raise --width or --dpi"
            )
        low, high = self._seen
        scale = height / (high[1] - low[1])
        size = math.ceil(2 * HALF * scale)
        left, top = round((HALF + low[0]) * scale), round((HALF - high[1]) * scale)
        left, top = min(max(left, 0), max(size - width, 0)), min(max(top, 0), max(size - height, 0))
        self._cut = slice(top, top + height), slice(left, left + width)
        self._renderer = Renderer(
            self.faces,
            template=self.shape,
            size=(max(size, height), max(size, width)),
            camera=self._camera,
            look=self.look,
            colours=self.colours,
        )

    def paint(self, vertices: Array, colours: npt.NDArray[np.uint8] | None = None) -> npt.NDArray[np.uint8]:
        """A picture (height, width, 3) of a face (V, 3) on pure white."""
        if self._renderer is None:
            raise ValueError("say the size first, with set_size")
        picture, backdrop = (
            each[self._cut] for each in (self._renderer.render(vertices, colours=colours), self._renderer.backdrop)
        )
        picture[(picture == backdrop).all(-1)] = 255  # the backdrop darkens towards its corners
        return picture


def _box_around(points: Array) -> Array:
    """The points with the corners of a larger box."""
    low, high = points.min(0), points.max(0)
    more = AROUND_LIPS / 2 * (high[0] - low[0])
    low, high = low - (more, more, 0), high + (more, more, 0)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), -1).reshape(-1, 3)
    return np.concatenate([points, corners])
