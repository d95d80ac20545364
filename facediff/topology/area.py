"""The area of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def surface_area(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> float:
    """Area of a triangle mesh: vertices (V, 3), faces (F, 3); in the square of the vertices' unit, in float64.

    The sum of all vertices' mixed Voronoi areas is the same figure.
    """
    first, second, third = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    (ax, ay, az), (bx, by, bz) = (second - first).T, (third - first).T
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    return 0.5 * float(np.sqrt(square).sum())
