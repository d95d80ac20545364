"""Buffers and the passes of OpenCV's software rasteriser that fill them."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.render.camera import FIELD_OF_VIEW, Camera

if TYPE_CHECKING:
    from types import ModuleType

# Windows start and end on multiples of this many pixels, so that nothing computed on a coarser grid inside
# them shimmers when a window grows with the motion.
GRID = 8


def opencv() -> "ModuleType":
    """OpenCV 5, or a sentence that says how to get it."""
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError("cv2", "render", "drawing meshes") from error
    if not hasattr(cv2, "triangleRasterize"):
        raise FaceDiffError(
            f"drawing meshes needs OpenCV 5 or later, but {cv2.__version__} is installed: "
            'run  pip install "facediff[render]"'
        )
    return cv2


class Window:
    """A rectangle of the picture, in pixels and in samples.

    Args:
        rows: first row and one past the last, in pixels.
        columns: likewise.
        supersample: samples per pixel and axis.
    """

    def __init__(self, rows: tuple[int, int], columns: tuple[int, int], supersample: int) -> None:
        self.pixels = (slice(*rows), slice(*columns))
        self.samples = tuple(slice(low * supersample, high * supersample) for low, high in (rows, columns))
        self.size = (columns[1] - columns[0], rows[1] - rows[0])

    def shrink(self, samples: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Average the samples of each pixel."""
        cv2 = opencv()
        return np.asarray(cv2.resize(samples, self.size, interpolation=cv2.INTER_AREA))


class Canvas:
    """A depth buffer and three interpolated values per sample.

    Depth is kept as the rasteriser has it (0 at the near plane, 1 at the far plane and where nothing is).
    Its other mode, which converts to distances and back around every call, loses what a second pass adds:
    the empty samples come back a rounding error behind the far plane and count as untouchable.

    Args:
        camera: where the picture is taken from.
        height: of the picture in pixels.
        width: of the picture in pixels.
        supersample: samples per pixel and axis.
    """

    def __init__(self, camera: Camera, height: int, width: int, supersample: int) -> None:
        self.camera = camera
        self.height, self.width, self.supersample = height, width, supersample
        self._depth = np.ones((height * supersample, width * supersample), np.float32)
        self._values = np.zeros((*self._depth.shape, 3), np.float32)
        self._blank = np.broadcast_to(np.array([-1, -1, 0], np.float32), self._values.shape).copy()

    def window(self, points: npt.NDArray[np.float64]) -> Window | None:
        """The part of the picture that can show the points (V, 3, camera axes); None if there is none."""
        ahead = points[points[:, 2] < -self.camera.near]
        if len(ahead) == 0:
            return None
        scale = self.height / 2 / math.tan(FIELD_OF_VIEW / 2) / -ahead[:, 2]
        row, column = self.height / 2 - scale * ahead[:, 1], self.width / 2 + scale * ahead[:, 0]
        limits = []
        for pixel, size in ((row, self.height), (column, self.width)):
            low = max((math.floor(pixel.min()) - 2) // GRID * GRID, 0)
            high = min(-((-math.ceil(pixel.max()) - 2) // GRID) * GRID, size)
            if high <= low:
                return None
            limits.append((low, high))
        return Window(limits[0], limits[1], self.supersample)

    def clear(self, window: Window) -> None:
        """Nothing drawn yet: depth 1, values (-1, -1, 0)."""
        self._depth[window.samples] = 1
        self._values[window.samples] = self._blank[window.samples]

    def draw(
        self,
        positions: npt.NDArray[np.float32],
        faces: npt.NDArray[np.int32],
        values: npt.NDArray[np.floating[Any]],
        side: str,
    ) -> None:
        """Interpolate values (V, 3) over the triangles where they are the nearest surface so far.

        Args:
            positions: vertices (V, 3) in camera axes.
            faces: triangles (F, 3).
            values: what to interpolate, in [0, 1].
            side: which side of the triangles, "front", "back" or "both".
        """
        cv2 = opencv()
        settings = cv2.TriangleRasterizeSettings()
        settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        culled = {"front": "CW", "back": "CCW", "both": "NONE"}[side]
        settings.setCullingMode(getattr(cv2, f"RASTERIZE_CULLING_{culled}"))
        lens = (FIELD_OF_VIEW, self.camera.near, self.camera.far)
        values, pose = values.astype(np.float32), np.eye(4, dtype=np.float32)
        cv2.triangleRasterize(positions, faces, values, self._values, self._depth, pose, *lens, settings)

    def value(self, window: Window, channel: int) -> npt.NDArray[np.float32]:
        """One of the three values per sample of the window."""
        return np.asarray(opencv().extractChannel(self._values[window.samples], channel), dtype=np.float32)

    def values(self, window: Window) -> npt.NDArray[np.float32]:
        """The three values per pixel of the window, averaged over its samples."""
        return window.shrink(self._values[window.samples])

    def coverage(self, window: Window) -> npt.NDArray[np.float32]:
        """Share of each pixel that the mesh covers."""
        cv2 = opencv()
        covered = window.shrink(cv2.compare(self._depth[window.samples], 1.0, cv2.CMP_LT))
        return np.asarray(covered * np.float32(1 / 255), dtype=np.float32)

    def distances(self, window: Window, coverage: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Mean distance of each pixel's covered samples from the camera; meaningless where it has none."""
        depth = window.shrink(self._depth[window.samples])
        depth += coverage
        depth -= 1  # what the empty samples added
        depth /= np.maximum(coverage, np.float32(1e-3))
        near, far = 1 / self.camera.near, 1 / self.camera.far
        return np.asarray(1 / (np.float32(near) + depth * np.float32(far - near)), dtype=np.float32)
