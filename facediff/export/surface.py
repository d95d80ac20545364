"""What the files say about a mesh beside its positions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.render.geometry import face_outward, vertex_normals
from facediff.render.shading import to_linear
from facediff.takes import Take


def outward(take: Take) -> npt.NDArray[np.int32]:
    """The triangles, counter-clockwise seen from outside.

    Raises:
        FaceDiffError: if the take has none.
    """
    return face_outward(take.triangles.astype(np.int32, copy=False), take.template.astype(np.float64))


def normals_of(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Unit normals (V, 3)."""
    return vertex_normals(vertices.astype(np.float64), faces).astype(np.float32)


def linear_colours(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.float32]:
    """Linear light within 0 and 1 of sRGB bytes (V, 3)."""
    return np.asarray(to_linear(colours / 255), np.float32)
