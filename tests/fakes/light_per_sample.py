"""The picture as it is defined: normals interpolated over the mesh as it is, the light looked up at every sample.

:class:`~facediff.render.Renderer` looks the light up at the vertices of a refined mesh, which takes half the time. Its
tests compare it with this one.
"""

from typing import Any

import cv2
import numpy as np

from facediff.render import Renderer
from facediff.render.meshes import Float64, Floats, hollowness, vertex_normals
from facediff.render.rasteriser import (
    FIELD_OF_VIEW,
    HOLLOW_STRENGTH,
    INSIDE,
    TABLE_SIZE,
    Float32,
    Picture,
    _Window,
    light_table,
)


class PerSampleRenderer(Renderer):
    """Draws normals, hollows and occlusion, then colours, and lights each sample."""

    def __init__(self, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 - those of Renderer
        super().__init__(*arguments, **options)
        self._table = light_table(self.look)

    def _draw(self, points: Float64, colours: Float32 | None, occluded: Float32 | None, window: _Window) -> Picture:
        normals = vertex_normals(points, self.faces, self._sums)
        shade = np.clip(1 - HOLLOW_STRENGTH * hollowness(points, normals, self._sums), 0, 1)
        shade = shade if occluded is None else shade * occluded
        front = np.column_stack([normals[:, :2] * 0.5 + 0.5, shade])
        back = np.column_stack([0.5 - normals[:, :2] * 0.5, INSIDE * shade])
        drawn, depth = self._samples(points, front, back, window)
        column, row = (np.ascontiguousarray(drawn[..., axis]) * (TABLE_SIZE - 1) for axis in (0, 1))
        table = cv2.remap(self._table, column, row, cv2.INTER_LINEAR)
        if colours is None:
            kept = drawn[..., 2:] * (1 - self._tint) + self._tint
            lit = (table[..., :3] * self._albedo + table[..., 3:]) * kept
        else:
            albedo, _ = self._samples(points, colours, colours, window)
            lit = (table[..., :3] * albedo + table[..., 3:]) * drawn[..., 2:]
        lit[depth >= 1] = 0
        self._canvas.depth[window.samples] = depth
        coverage = self._canvas.coverage(window)
        picture = window.shrink(lit) * self._kept_light(coverage, window, tinted=colours is None) / self._strongest
        picture += self._background[window.pixels] * (1 - coverage)[..., None]
        return self._to_bytes(picture.astype(np.float32))

    def _samples(self, points: Float64, front: Floats, back: Floats, window: _Window) -> tuple[Float32, Float32]:
        """Values of fronts and, where one looks inside, of backs, and their depth, per sample of the window."""
        canvas = self._canvas
        canvas.clear(window)
        settings = cv2.TriangleRasterizeSettings()
        settings.setShadingType(cv2.RASTERIZE_SHADING_SHADED)
        settings.setGlCompatibleMode(cv2.RASTERIZE_COMPAT_INVDEPTH)
        lens = (FIELD_OF_VIEW, self.camera.near, self.camera.far)
        for values, culled in ((front, "CW"), (back, "CCW")):
            if culled == "CW" or self._open:
                settings.setCullingMode(getattr(cv2, f"RASTERIZE_CULLING_{culled}"))
                arrays = (points.astype(np.float32), self.faces, values.astype(np.float32), canvas.values, canvas.depth)
                cv2.triangleRasterize(*arrays, np.eye(4, dtype=np.float32), *lens, settings)
        return canvas.values[window.samples].copy(), canvas.depth[window.samples].copy()
