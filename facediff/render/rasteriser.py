"""Meshes to pictures without display or GPU, on the software rasteriser of OpenCV 5."""

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.render.camera import Camera
from facediff.render.canvas import Canvas, Window, opencv
from facediff.render.geometry import (
    check_faces,
    check_vertices,
    face_outward,
    hollowness,
    is_open,
    vertex_normals,
)
from facediff.render.shading import TABLE_SIZE, Look, background, light_table, to_linear, to_srgb

# What is seen of a face's back keeps this share of its light: the inside of a head is dark.
INSIDE = 0.2

# How strongly hollows of the surface, and points lying behind their surroundings, are darkened.
HOLLOW_STRENGTH = 0.45
DEPTH_STRENGTH = 14.0

# Steps of the gamma table: fine enough that the darkest step stays below one level of the picture.
_LEVELS = 4095


class Renderer:
    """Draws one topology in one view; keeps its buffers between frames, so use one per thread.

    Normals are recomputed for every frame and interpolated over the triangles; the light is looked up per
    sample of the supersampled picture (see `shading`), averaged in linear light and gamma-corrected last.
    The same input gives the same bytes. `backdrop` is the picture (height, width, 3) without the mesh.

    Args:
        faces: triangles (F, 3) as vertex numbers; either winding.
        template: rest positions (V, 3), y up and z to the viewer, in any unit; the camera is framed on them.
        size: height and width of the picture in pixels, one number for a square.
        view: "front", "three_quarter" or "side"; ignored where a camera is given.
        supersample: samples per pixel and axis; 1 switches anti-aliasing off.
        camera: a camera to use instead, such as one shared by several topologies.
        look: material, lights and background.
        colours: sRGB per vertex (V, 3) for frames that bring none, floats in [0, 1] or uint8; without
            them the look's material.
    """

    def __init__(
        self,
        faces: npt.ArrayLike,
        *,
        template: npt.ArrayLike,
        size: int | tuple[int, int] = 512,
        view: str = "front",
        supersample: int = 2,
        camera: Camera | None = None,
        look: Look | None = None,
        colours: npt.ArrayLike | None = None,
    ) -> None:
        rest = check_vertices(template, "template")
        self.n_vertices = len(rest)
        self.faces = face_outward(check_faces(faces, self.n_vertices), rest)
        self.height, self.width = (size, size) if isinstance(size, int) else size
        if min(self.height, self.width) < 16 or max(self.height, self.width) > 8192:
            raise FaceDiffError(f"size is {size}: give 16 to 8192 pixels for height and width.")
        if not 1 <= supersample <= 8:
            raise FaceDiffError(f"supersample is {supersample}: give 1 (no anti-aliasing) to 8.")
        self.camera = camera or Camera.framing(rest, view=view, aspect=self.width / self.height)
        self.look = look or Look()
        self._colours = None if colours is None else self._check_colours(colours)
        self._open = is_open(self.faces)
        self._canvas = Canvas(self.camera, self.height, self.width, supersample)
        self._table = light_table(self.look)
        self._gamma = np.rint(255 * to_srgb(np.linspace(0, 1, _LEVELS + 1))).astype(np.uint8)
        self._background = background(self.look, self.height, self.width)
        self.backdrop = self._to_bytes(self._background.copy())

    def render(self, vertices: npt.ArrayLike, *, colours: npt.ArrayLike | None = None) -> npt.NDArray[np.uint8]:
        """Draw one frame.

        Args:
            vertices: absolute positions (V, 3) in the template's unit.
            colours: sRGB per vertex (V, 3), floats in [0, 1] or uint8; without them the renderer's own.

        Returns:
            The picture (height, width, 3), sRGB.
        """
        points = self.camera.to_camera(check_vertices(vertices, "vertices", self.n_vertices))
        tints = self._colours if colours is None else self._check_colours(colours)
        picture = self.backdrop.copy()
        window = self._canvas.window(points)
        if window is not None:
            picture[window.pixels] = self._draw(points, tints, window)
        return picture

    def animate(
        self, motion: Iterable[npt.ArrayLike], *, colours: npt.NDArray[Any] | None = None
    ) -> Iterator[npt.NDArray[np.uint8]]:
        """Draw frame after frame: positions (T, V, 3) and, where given, colours (V, 3) or (T, V, 3)."""
        for index, vertices in enumerate(motion):
            now = colours[index] if colours is not None and colours.ndim == 3 else colours
            yield self.render(vertices, colours=now)

    def _draw(
        self, points: npt.NDArray[np.float64], colours: npt.NDArray[np.float32] | None, window: Window
    ) -> npt.NDArray[np.uint8]:
        """The window's pixels: rasterise, light, darken hollows, put over the background, gamma-correct."""
        cv2, canvas = opencv(), self._canvas
        positions = points.astype(np.float32)
        self._draw_normals(points, positions, window)
        coverage = canvas.coverage(window)
        # Samples that no triangle reached hold -1 and fall off the table: remap gives them no light.
        column, row = canvas.value(window, 0), canvas.value(window, 1)
        column *= np.float32(TABLE_SIZE - 1)
        row *= np.float32(TABLE_SIZE - 1)
        lit = window.shrink(cv2.remap(self._table, column, row, cv2.INTER_LINEAR))
        kept = self._kept_light(coverage, window)
        if colours is None:
            picture = lit[..., :3] * to_linear(self.look.albedo)
            hollow = np.asarray(self.look.hollow, np.float32)
            kept = kept * (1 - hollow) + hollow
        else:
            picture = lit[..., :3] * self._draw_albedo(positions, colours, coverage, window)
        picture += lit[..., 3:]
        picture *= kept
        picture += self._background[window.pixels] * (1 - coverage)[..., None]
        return self._to_bytes(picture)

    def _draw_normals(
        self, points: npt.NDArray[np.float64], positions: npt.NDArray[np.float32], window: Window
    ) -> None:
        """Fill the canvas with the normal's x and y in [0, 1] and the share of light that a hollow leaves."""
        normals = vertex_normals(points, self.faces)
        shade = np.clip(1 - HOLLOW_STRENGTH * hollowness(points, normals, self.faces), 0, 1)
        self._canvas.clear(window)
        front = np.column_stack([normals[:, :2] * 0.5 + 0.5, shade])
        self._canvas.draw(positions, self.faces, front, "front")
        if self._open:
            # Backs are drawn against the same depth: they show only where one looks inside.
            back = np.column_stack([0.5 - normals[:, :2] * 0.5, INSIDE * shade])
            self._canvas.draw(positions, self.faces, back, "back")

    def _draw_albedo(
        self,
        positions: npt.NDArray[np.float32],
        colours: npt.NDArray[np.float32],
        coverage: npt.NDArray[np.float32],
        window: Window,
    ) -> npt.NDArray[np.float32]:
        """Linear surface colour per pixel from linear colours per vertex; overwrites the canvas."""
        self._canvas.clear(window)
        self._canvas.draw(positions, self.faces, colours, "both" if self._open else "front")
        albedo = self._canvas.values(window)
        albedo[..., :2] += (1 - coverage)[..., None]  # the blank's -1 in the samples not covered
        return np.asarray(albedo / np.maximum(coverage, np.float32(1e-3))[..., None], dtype=np.float32)

    def _kept_light(self, coverage: npt.NDArray[np.float32], window: Window) -> npt.NDArray[np.float32]:
        """Share of the light that is left where the surface lies in a hollow, per pixel (height, width, 1).

        Two cues: the surface's own hollows, and pixels that lie behind the mean depth of their
        surroundings (depth-buffer unsharp masking), which darkens the mouth between the lips.
        """
        cv2, (width, height) = opencv(), window.size
        shade = window.shrink(self._canvas.value(window, 2))
        shade /= np.maximum(coverage, np.float32(1e-3))
        distances = self._canvas.distances(window, coverage)
        small = (max(width // 4, 1), max(height // 4, 1))
        sums = [cv2.resize(image, small, interpolation=cv2.INTER_AREA) for image in (distances * coverage, coverage)]
        mean, weight = (cv2.GaussianBlur(image, (0, 0), 0.0075 * self.height) for image in sums)
        mean /= np.maximum(weight, np.float32(1e-3))
        distances -= cv2.resize(mean, (width, height), interpolation=cv2.INTER_LINEAR)
        behind = np.maximum(distances, 0, out=distances)
        behind *= coverage
        behind *= np.float32(DEPTH_STRENGTH / self.camera.radius)
        return np.asarray((shade / (1 + behind))[..., None], dtype=np.float32)

    def _to_bytes(self, picture: npt.NDArray[np.float32]) -> npt.NDArray[np.uint8]:
        """Linear light to sRGB bytes; overwrites its input."""
        np.clip(picture, 0, 1, out=picture)
        picture *= np.float32(_LEVELS)
        picture += np.float32(0.5)
        return np.take(self._gamma, picture.astype(np.uint16))

    def _check_colours(self, colours: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Colours per vertex as linear float32."""
        array = np.asarray(colours)
        values = check_vertices(array / 255 if array.dtype == np.uint8 else array, "colours", self.n_vertices)
        if values.min() < 0 or values.max() > 1:
            raise FaceDiffError("colours must be floats in [0, 1] or uint8: scale them before drawing.")
        return to_linear(values)
