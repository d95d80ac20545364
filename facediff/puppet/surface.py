"""The skin of the head as a function of two parameters, in millimetres.

The head is a stack of closed horizontal curves: ``theta`` runs round the head from the front midline (0) to
the back (pi), ``level`` climbs from the neck to the crown and equals the height y in the face. The tables
below give each curve's extent; the face is modelled on top by smooth hills and hollows of `_relief`.
Only the left half (x >= 0) is described; the other half is its mirror image.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from facediff.puppet.curves import Array, bump, rise, through

EYE_CENTRE = (31.0, 25.5, 63.0)
LID_RADIUS = 15.0
MOUTH_Y = -48.0
LOWEST_LEVEL, HIGHEST_LEVEL = -150.0, 150.0

# level, height y, front z, z of the widest place, half width, back z, how much the curve climbs to the sides
_CURVES = np.array(
    [
        [-150, -150, 27, -22, 50, -80, 0],
        [-128, -130, 29, -20, 46, -76, 4],
        [-113, -112, 35, -14, 45.5, -76, 16],
        [-101, -101, 58, -2, 49.5, -77, 30],
        [-91, -92, 78, 3, 57, -79, 40],
        [-79, -79, 87, 4, 61.5, -82, 40],
        [-66, -66, 88, 4, 65, -85, 33],
        [-48, -48, 91, 3, 68, -90, 21],
        [-24, -24, 92, 2, 71, -95, 9],
        [0, 0, 90, 0, 73.5, -99, 2],
        [25, 25, 87.5, -2, 75, -102, 0],
        [45, 45, 92, -4, 75.5, -103, 0],
        [70, 70, 91, -5, 74, -100, 0],
        [98, 97, 79, -6, 66, -89, 0],
        [120, 115.5, 60, -6, 53, -70, 0],
        [142, 128, 37, -6, 36, -47, 0],
        [156, 133.5, 20, -6, 21, -31, 0],
    ],
    dtype=np.float64,
)
CROWN = (0.0, 135.5, -6.0)


def _curve(level: ArrayLike, column: int) -> Array:
    return through(_CURVES[:, 0], _CURVES[:, column], level)


def radius(level: ArrayLike) -> Array:
    """Length in mm that the layout gives to a radian at a level.

    Half way (as a geometric mean) between the true radius and a constant one: the true one would shear the
    back of the crown and the nape, where it changes fast, a constant one would blow up the crown.
    """
    true = 0.5 * _curve(level, 4) + 0.25 * (_curve(level, 2) - _curve(level, 5))
    return np.asarray(np.sqrt(82.0 * true))


def _climb(theta: ArrayLike) -> Array:
    return rise(theta, 0.3, 1.4)


def locate(x: ArrayLike, y: ArrayLike) -> tuple[Array, Array]:
    """Find the parameters of a place on the front of the head.

    Args:
        x: Distance from the midline, in mm, less than the head's half width.
        y: Height, in mm.

    Returns:
        ``theta`` and ``level`` of the skin in front of (x, y), before the relief.
    """
    across, height = np.asarray(x, dtype=np.float64), np.asarray(y, dtype=np.float64)
    level = height.copy()
    theta = np.zeros_like(across)
    for _ in range(30):
        theta = np.arcsin(np.clip(across / _curve(level, 4), 0.0, 1.0))
        level = level + 0.7 * (height - _curve(level, 1) - _curve(level, 6) * _climb(theta))
    return theta, level


def skin(theta: ArrayLike, level: ArrayLike) -> Array:
    """Place points on the skin.

    Args:
        theta: Angle round the head, 0 (front) to pi (back), shape (n,).
        level: Level, shape (n,).

    Returns:
        Positions in mm, shape (n, 3).
    """
    angle = np.asarray(theta, dtype=np.float64)
    front, widest, back = _curve(level, 2), _curve(level, 3), _curve(level, 5)
    cosine = np.cos(angle)
    x = _curve(level, 4) * np.sin(angle)
    y = _curve(level, 1) + _curve(level, 6) * _climb(angle)
    z = widest + np.where(cosine > 0, front - widest, widest - back) * cosine
    facing = rise(cosine, 0.0, 0.45)
    z = z + facing * _relief(x, y)
    z = _over_eyeball(x, y, z, facing)
    y = y - 2.5 * facing * bump(x, y, (0.0, -13.0), (9.0, 6.0))
    return np.stack([x, y, z], axis=-1)


def _relief(x: Array, y: Array) -> Array:
    """How far the face stands out of the plain head, in mm."""
    z = -6.0 * bump(x, y, (32, 24), (13, 9))
    z += -8.0 * bump(x, y, (18, 24), (6.5, 10))
    z += 2.5 * bump(x, y, (17, 42), (11, 5)) + 2.5 * bump(x, y, (38, 43), (11, 5))
    z += 4.0 * bump(x, y, (44, -3), (13, 11)) - 3.0 * bump(x, y, (52, -42), (12, 16))
    z += -2.5 * bump(x, y, (66, 55), (10, 16)) + 1.5 * bump(x, y, (24, 76), (18, 14))
    z += 3.5 * bump(x, y, (0, -44), (24, 15)) - 3.4 * bump(x, y, (0, -67), (16, 6.0))
    z += 6.0 * bump(x, y, (0, -82), (13, 9)) - 1.0 * bump(x, y, (0, -32), (2.6, 5))
    return z + _nose(x, y) + _smile_fold(x, y)


def _nose(x: Array, y: Array) -> Array:
    """Ridge, tip and wings of the nose, with a hollow for the nostril."""
    height = through(
        [-29, -25, -22, -18, -13.5, -9, 0, 12, 22, 30, 40],
        [0, 1.5, 5.0, 12.0, 18.5, 20.5, 17.5, 12.0, 7.0, 3.5, 0],
        y,
    )
    width = through([-25, -10, 0, 12, 26, 40], [7.5, 7.5, 6.3, 5.8, 5.5, 8], y)
    ridge = height * np.exp(-0.5 * np.abs(x / width) ** 2.2)
    wing = 8.5 * bump(x, y, (14.5, -15.5), (4.2, 5.2))
    nostril = -2.5 * bump(x, y, (7.0, -20.5), (2.6, 2.2))
    return ridge + wing + nostril


def _smile_fold(x: Array, y: Array) -> Array:
    """Slight fold from the wing of the nose to beside the mouth."""
    along = np.clip((-14.0 - y) / 34.0, 0.0, 1.0)
    beside = x - (20.0 + 13.0 * along)
    fade = rise(y, -58.0, -40.0) * rise(y, -8.0, -20.0)
    return fade * (1.6 * np.exp(-0.5 * ((beside - 6.0) / 5.0) ** 2) - 1.4 * np.exp(-0.5 * (beside / 3.0) ** 2))


def _over_eyeball(x: Array, y: Array, z: Array, facing: Array) -> Array:
    """Lay the lids over the eyeball: a smooth maximum of the skin and a ball."""
    room = LID_RADIUS**2 - (x - EYE_CENTRE[0]) ** 2 - (y - EYE_CENTRE[1]) ** 2
    ball = EYE_CENTRE[2] + np.sqrt(np.maximum(room, 1e-6))
    softness = 1.5
    gap = np.clip((ball - z) / softness, -30.0, 30.0)
    over = z + softness * np.log1p(np.exp(gap))
    blend = facing * rise(room, -40.0, 30.0)
    return np.asarray(z + blend * (over - z))
