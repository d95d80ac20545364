"""The normalisation of BIWI that CodeTalker introduced and that most later work takes over.

Source: the preprocessing published with CodeTalker (Xing et al., CVPR 2023; repository Doubiiu/CodeTalker).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def surface_area(vertices: npt.NDArray[np.float64], faces: npt.NDArray[np.integer]) -> float:
    """Area of a triangle mesh: vertices (V, 3), faces (F, 3); in the square of the vertices' unit.

    The sum of all vertices' mixed Voronoi areas is the same figure.
    """
    first, second, third = (vertices[faces[:, corner]] for corner in range(3))
    (ax, ay, az), (bx, by, bz) = (second - first).T, (third - first).T
    square = (ay * bz - az * by) ** 2 + (az * bx - ax * bz) ** 2 + (ax * by - ay * bx) ** 2
    return 0.5 * float(np.sqrt(square).sum())


def codetalker(vertices: npt.NDArray[np.floating], faces: npt.NDArray[np.integer]) -> npt.NDArray[np.float64]:
    """Turn a frame (V, 3) by pi about x, centre it on its own mean vertex, scale it to a surface area of one.

    Mean and area are the frame's own. An opening jaw moves the mean and enlarges the area, so a part of its motion
    becomes a shift and a scale of the whole face; what was published on BIWI contains this, and so must this.

    Raises:
        ValueError: if the mesh has no area, or a vertex is not finite.
    """
    turned = np.asarray(vertices, np.float64) * (1.0, -1.0, -1.0)
    centred = turned - turned.mean(axis=0)
    area = surface_area(centred, faces)
    if not (np.isfinite(area) and area > 0):
        raise ValueError(f"a surface area of {area}")
    return centred / np.sqrt(area)
