"""The skin of an average adult head as a smooth surface, before eyes and mouth are cut into it.

A point of the surface has an angle round the head (0 at the middle of the face, pi at the back) and a level, the length
of the front midline from the base of the neck in mm. Lengths are in mm; x points to the face's left, y up, z to the
viewer. The origin lies between the ears, 25 mm below the eyes.

Sizes follow the means of adults in Farkas, "Anthropometry of the head and face" (1994), rounded between women and men:
width of the head 150, length 190, width of the face 137, of the lower jaw 105, of the mouth 50, of the nose 34, from
the root of the nose to its base 51, from there to the chin 68, between the pupils 62.
"""

from __future__ import annotations

import numpy as np

from facediff.synthetic.geometry import Array, bump, rise, spline, through

# A row for each level: height in mm at the front and at the side, distance of the front, of the side and of the back
# from the axis, and the exponent of the superellipse through them (2 is an ellipse, more is squarer). Under the chin
# the surface runs backwards and not down, so that many rows have nearly one height at the front.
_ROWS = np.array(
    [
        (-215, -200, 78, 150, 105, 2.6),
        (-198, -178, 70, 139, 104, 2.5),
        (-184, -160, 57, 114, 100, 2.3),
        (-171, -145, 41, 83, 93, 2.1),
        (-158, -132, 33, 65, 85, 2.0),
        (-143, -119, 31, 56, 78, 2.0),
        (-127, -105, 34, 51, 73.5, 2.0),
        (-112, -91, 41, 49, 71, 2.0),
        (-101, -77, 53, 48.5, 71.5, 1.96),
        (-96, -69, 68, 50.5, 73, 1.9),
        (-91, -61.5, 79.5, 54.5, 76, 1.84),
        (-83.5, -53, 86.5, 57.5, 79.5, 1.84),
        (-74, -43, 88, 60, 84, 1.88),
        (-64, -33, 86.5, 62.5, 87.5, 1.92),
        (-46, -18, 89, 65.2, 92, 2.0),
        (-27, -3, 88.5, 67.7, 95, 2.1),
        (-5, 11, 87, 70, 97.5, 2.22),
        (22, 28, 86.5, 72, 99, 2.32),
        (42, 46, 91.5, 73.8, 99.5, 2.34),
        (66, 67, 90.5, 75, 98, 2.22),
        (88, 88, 81.5, 71, 91, 2.1),
        (107, 107, 66, 60, 78, 2.05),
        (121, 121, 45, 42, 54, 2.0),
        (130, 130, 23.5, 24, 28, 2.0),
        (132.5, 132.5, 6, 6.5, 7, 2.0),
    ]
)
_BACK_EXPONENT = 2.15
_LEVELS = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(_ROWS[:, 0]), np.diff(_ROWS[:, 2])))])

_ROW_AT = spline(_LEVELS, _ROWS)

TOP = float(_LEVELS[-1])
"""The highest level, close to the crown."""


def level_of(height: Array | float) -> Array:
    """The level at which the front midline has a height, in mm."""
    return np.asarray(np.interp(height, _ROWS[:, 0], _LEVELS))


def level_at(theta: Array, height: Array) -> Array:
    """The level (n,) at which the surface has a height in mm, at angles (n,)."""
    turn = rise(theta, 0.0, 1.45)
    columns = (_ROWS[:, 0] + share * (_ROWS[:, 1] - _ROWS[:, 0]) for share in turn)
    return np.array([np.interp(up, column, _LEVELS) for up, column in zip(height, columns, strict=True)])


def skin(theta: Array, level: Array) -> Array:
    """Points (..., 3) of the surface at angles and levels of one shape."""
    return _with_features(_skull(theta, level))


def _skull(theta: Array, level: Array) -> Array:
    """The head without nose, sockets and lips."""
    front_height, side_height, front, side, back, exponent = np.moveaxis(_ROW_AT(level), -1, 0)
    across, ahead = np.sin(theta), np.cos(theta)
    depth = np.where(ahead >= 0, front, back)
    power = np.where(ahead >= 0, exponent, _BACK_EXPONENT)
    radius = (np.abs(across / side) ** power + np.abs(ahead / depth) ** power) ** (-1.0 / power)
    height = front_height + (side_height - front_height) * rise(theta, 0.0, 1.45)
    return np.stack([radius * across, height, radius * ahead], axis=-1)


def plane_of(front: Array) -> Array:
    """Angles and levels (n, 2) of the points of the front that are seen at (x, y), both (n, 2)."""
    across, height = np.asarray(front, dtype=np.float64).T
    theta, level = np.arcsin(np.clip(across / 80.0, 0.0, 0.99)), level_of(height)
    for _ in range(60):  # a fixed-point iteration: x grows with the angle, y with the level, both nearly linearly
        point = _skull(theta, level)
        theta = np.clip(theta + 0.7 * (across - point[:, 0]) / 80.0, 0.0, 1.5)
        level = level + 0.6 * (height - point[:, 1])
    return np.stack([np.where(across == 0.0, 0.0, theta), level], axis=1)


def skin_at(front: Array) -> Array:
    """Points (n, 3) of the skin that are seen at (x, y) from the front."""
    point = skin(*plane_of(front).T)
    point[np.asarray(front)[:, 0] == 0.0, 0] = 0.0
    return point


# The nose by height: how far it stands out, and its half width.
_NOSE_LEVELS = (-29.5, -26.5, -23, -18, -13, -7, 4, 14, 24, 33, 42)
_NOSE_DEPTHS = (0, 3.5, 12.5, 18.6, 20.6, 18.8, 13.4, 8.4, 4.2, 1.4, 0)
_NOSE_WIDTH_LEVELS = (-30, -24, -17, -10, -2, 10, 24, 36)
_NOSE_WIDTHS = (7, 8, 9.2, 9, 8.0, 6.4, 5.6, 7.0)


def _with_features(points: Array) -> Array:
    """The skull with forehead, sockets, nose, cheeks, muzzle and chin: hills and hollows on its front."""
    x, y, z = np.abs(points[..., 0]), points[..., 1], points[..., 2]
    front = rise(z, 10, 45)
    forward = 1.5 * bump(x, y, (24, 76), (18, 16))  # forehead
    forward += 1.6 * bump(x, y, (22, 42), (12, 6)) + 1.8 * bump(x, y, (40, 40), (10, 6))  # ridge of the brow
    forward += 0.6 * bump(x, y, (0, 44), (12, 7))
    forward -= 6.0 * bump(x, y, (18, 25), (6.0, 9)) + 7.0 * bump(x, y, (31, 25), (12, 10))  # socket
    forward -= 2.5 * bump(x, y, (46, 25), (8, 9))
    forward += 3.0 * bump(x, y, (44, 2), (14, 11))  # cheekbone
    forward += 1.6 * bump(x, y, (28, -20), (8, 12)) - 2.0 * bump(x, y, (34, -34), (10, 14))  # fold and hollow of cheek
    forward += 3.0 * bump(x, y, (0, -42), (22, 20))  # muzzle
    forward += 2.5 * bump(x, y, (0, -83), (15, 9)) - 1.8 * bump(x, y, (0, -65), (14, 4.5))  # chin
    forward += 0.5 * bump(x, y, (5, -34), (2.4, 6)) - 0.9 * bump(x, y, (0, -34), (2.6, 6))  # philtrum
    forward += _nose(x, y)
    sideways = -3.0 * bump(y, z, (48, 38), (20, 16)) * rise(x, 35, 60)  # temple
    sideways += 2.5 * bump(y, z, (4, 42), (14, 20)) * rise(x, 30, 60)  # cheekbone
    sideways -= 2.5 * bump(y, z, (-34, 38), (16, 18)) * rise(x, 30, 60)  # hollow of the cheek
    sideways += 1.5 * bump(y, z, (-46, 14), (14, 18)) * rise(x, 30, 60)  # angle of the jaw
    return points + np.stack([sideways, np.zeros_like(y), front * forward], axis=-1)


def _nose(x: Array, y: Array) -> Array:
    """How far the nose stands out: a narrow back, wings, and the groove beside them."""
    out = through(_NOSE_LEVELS, _NOSE_DEPTHS, y)
    width = through(_NOSE_WIDTH_LEVELS, _NOSE_WIDTHS, y)
    # A steep ridge on a wide foot, so that the side of the nose runs out into the cheek without an edge.
    ridge = 0.64 * np.exp(-0.9 * (x / width) ** 2.6) + 0.36 * np.exp(-((x / (1.9 * width)) ** 2))
    wing = 9.5 * bump(x, y, (13.0, -19.5), (3.8, 5.2)) - 2.6 * bump(x, y, (18.8, -15.0), (1.9, 6.5))
    return np.asarray(out * ridge + wing + 1.6 * bump(x, y, (0, -13), (6.5, 6)))
