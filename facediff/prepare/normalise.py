"""The normalisation of BIWI that CodeTalker introduced and that most later work takes over.

Source: the preprocessing published with CodeTalker (Xing et al., CVPR 2023; repository Doubiiu/CodeTalker).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.topology.area import surface_area


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
