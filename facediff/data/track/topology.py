"""The face of 468 vertices: regions, pairs of vertices, and the triangles that leave eyes and mouth open.

Vertices are numbered as in MediaPipe's canonical face, in its ``geometry_pipeline_metadata_landmarks.binarypb``.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

IRIS = {"right": 468, "left": 473}
"""Centres of the irises; the four points of a rim follow each."""
EYE_CORNERS = {"right": (33, 133), "left": (263, 362)}

INNER_LIPS = (78, 191, 80, 81, 82, 13, 312, 311, 310, 415, 308, 324, 318, 402, 317, 14, 87, 178, 88, 95)
RIGHT_LIDS = (33, 246, 161, 160, 159, 158, 157, 173, 133, 155, 154, 153, 145, 144, 163, 7)
LEFT_LIDS = (263, 466, 388, 387, 386, 385, 384, 398, 362, 382, 381, 380, 374, 373, 390, 249)
"""Vertices of the rims of mouth and eyes."""

LIPS = (
    *(0, 13, 14, 17, 37, 39, 40, 61, 78, 80, 81, 82, 84, 87, 88, 91, 95, 146, 178, 181, 185, 191, 267, 269, 270, 291),
    *(308, 310, 311, 312, 314, 317, 318, 321, 324, 375, 402, 405, 409, 415),
)
UPPER_FACE = (
    *(7, 8, 9, 10, 33, 46, 52, 53, 54, 55, 63, 65, 66, 67, 68, 69, 70, 103, 104, 105, 107, 109, 133, 144, 145, 151),
    *(153, 154, 155, 157, 158, 159, 160, 161, 163, 173, 246, 249, 263, 276, 282, 283, 284, 285, 293, 295, 296, 297),
    *(298, 299, 300, 332, 333, 334, 336, 338, 362, 373, 374, 380, 381, 382, 384, 385, 386, 387, 388, 390, 398, 466),
)
BROWS = (46, 52, 53, 55, 63, 65, 66, 70, 105, 107, 276, 282, 283, 285, 293, 295, 296, 300, 334, 336)
LIP_PAIRS = ((13, 14), (82, 87), (312, 317), (81, 178), (311, 402), (80, 88), (310, 318))
EYELID_PAIRS = ((159, 145), (158, 153), (160, 144), (386, 374), (385, 380), (387, 373))

Triangles = npt.NDArray[np.int64]


def without_webs(triangles: Triangles) -> Triangles:
    """Triangles (F, 3) without those across the mouth and the eyes: 852 of the 898 of the file."""
    inside = [np.isin(triangles, rim).all(axis=1) for rim in (INNER_LIPS, RIGHT_LIDS, LEFT_LIDS)]
    return triangles[~np.any(inside, axis=0)]


def sharpness(triangles: Triangles, count: int) -> npt.NDArray[np.float64]:
    """How far the motion of lips and lids is smoothed little (V,): 1 there, 2/3 and 1/3 in two rings round them."""
    weights = np.zeros(count)
    weights[[*LIPS, *RIGHT_LIDS, *LEFT_LIDS]] = 1
    for weight in (2 / 3, 1 / 3):
        ring = triangles[(weights[triangles] > 0).any(axis=1)]
        weights[ring] = np.maximum(weights[ring], weight)
    return weights
