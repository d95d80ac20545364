"""Rotations in the forms that files write them in, and between two of them.

Every form is turned into unit quaternions (w, x, y, z) and back, so that four pairs of functions give all conversions.
Angles are in radians; matrices act on columns.
"""

from __future__ import annotations

import numpy as np

from facediff.spaces.space import Form
from facediff.utils.numerics import Array, Floats

SMALL = 1e-8  # Angle below which sin(a / 2) / a is its limit


def convert(values: Floats, source: Form, target: Form) -> Array:
    """Rotations (..., width of the source's form) in another form (..., width of the target's).

    Axis-angle vectors come back with an angle of at most π, quaternions with w of at least 0.

    Args:
        values: the rotations.
        source: their form: ``axis_angle``; ``axis_angle_x``, a turn about x; ``six_d``, the first two columns of the
            matrix, one after the other, which are made orthonormal (Zhou et al., "On the continuity of rotation
            representations in neural networks", CVPR 2019); ``quaternion`` w, x, y, z, which is normalised; ``euler``,
            yaw about y, then pitch about the turned x, then roll about the z turned by both.
        target: the form that is returned. ``axis_angle_x`` drops what turns about other axes.

    Example:
        >>> convert(np.array([[0.0, 0.0, np.pi / 2]]), "axis_angle", "six_d").round(6) + 0.0
        array([[ 0.,  1.,  0., -1.,  0.,  0.]])
    """
    return _WRITE[target](_READ[source](np.asarray(values, np.float64)))


def slerp(first: Array, second: Array, share: Array) -> Array:
    """Unit quaternions (T, 4) on the shortest way from one rotation (T, 4) to another, by shares (T,) of it."""
    cosine = (first * second).sum(-1, keepdims=True)
    # q and −q are one rotation; the nearer of them is the shorter way.
    second = np.where(cosine < 0, -second, second)
    angle = np.arccos(np.clip(np.abs(cosine), 0.0, 1.0))
    share = share[:, None]
    sine = np.where(angle < SMALL, 1.0, np.sin(angle))
    weights = [np.where(angle < SMALL, part, np.sin(part * angle) / sine) for part in (1.0 - share, share)]
    return _unit(weights[0] * first + weights[1] * second)


def _unit(values: Array) -> Array:
    length = np.linalg.norm(values, axis=-1, keepdims=True)
    return np.asarray(values / np.where(length > 0, length, 1.0))


def _from_axis_angle(values: Array) -> Array:
    angle = np.linalg.norm(values, axis=-1, keepdims=True)
    # sin(a / 2) / a without a division by zero: sinc is sin(π x) / (π x).
    return np.concatenate([np.cos(angle / 2), values * (0.5 * np.sinc(angle / (2 * np.pi)))], axis=-1)


def _to_axis_angle(quaternions: Array) -> Array:
    scalar, vector = quaternions[..., :1], quaternions[..., 1:]
    vector, scalar = np.where(scalar < 0, -vector, vector), np.abs(scalar)
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, scalar)
    return np.asarray(vector * np.where(sine < SMALL, 2.0, angle / np.where(sine < SMALL, 1.0, sine)))


def _from_x(values: Array) -> Array:
    return np.concatenate([np.cos(values / 2), np.sin(values / 2), *2 * [np.zeros_like(values)]], axis=-1)


def _from_matrices(matrices: Array) -> Array:
    """Shepperd's method: of four formulas, the one with the largest divisor."""
    m = matrices
    diagonal = np.stack([m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]], axis=-1)
    trace = diagonal.sum(-1, keepdims=True)
    # Four times the squares of w, x, y, z.
    squares = 1.0 + np.concatenate([trace, 2.0 * diagonal - trace], axis=-1)
    wx, wy, wz = m[..., 2, 1] - m[..., 1, 2], m[..., 0, 2] - m[..., 2, 0], m[..., 1, 0] - m[..., 0, 1]
    xy, xz, yz = m[..., 0, 1] + m[..., 1, 0], m[..., 0, 2] + m[..., 2, 0], m[..., 1, 2] + m[..., 2, 1]
    w, x, y, z = np.moveaxis(squares, -1, 0)
    # Row k is the quaternion times four times its own component k.
    rows = np.stack(
        [np.stack(row, axis=-1) for row in ((w, wx, wy, wz), (wx, x, xy, xz), (wy, xy, y, yz), (wz, xz, yz, z))],
        axis=-2,
    )
    largest = squares.argmax(-1)[..., None, None]
    return _unit(np.take_along_axis(rows, largest, axis=-2)[..., 0, :])


def matrices(quaternions: Array) -> Array:
    """Rotation matrices (..., 3, 3) of unit quaternions (..., 4)."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def _from_six(values: Array) -> Array:
    first = _unit(values[..., :3])
    second = values[..., 3:]
    second = _unit(second - (first * second).sum(-1, keepdims=True) * first)
    return _from_matrices(np.stack([first, second, np.cross(first, second)], axis=-1))


def _to_six(quaternions: Array) -> Array:
    columns = np.swapaxes(matrices(quaternions), -1, -2)
    return np.concatenate([columns[..., 0, :], columns[..., 1, :]], axis=-1)


def _from_euler(values: Array) -> Array:
    yaw, pitch, roll = np.moveaxis(values / 2, -1, 0)
    (cy, cp, cr), (sy, sp, sr) = ([of(angle) for angle in (yaw, pitch, roll)] for of in (np.cos, np.sin))
    parts = (
        cy * cp * cr + sy * sp * sr,
        cy * sp * cr + sy * cp * sr,
        sy * cp * cr - cy * sp * sr,
        cy * cp * sr - sy * sp * cr,
    )
    return np.stack(parts, axis=-1)


def _to_euler(quaternions: Array) -> Array:
    m = matrices(quaternions)
    pitch = np.arcsin(np.clip(-m[..., 1, 2], -1.0, 1.0))
    # With the face straight up or down, yaw and roll turn about one axis: roll is 0 then, and yaw is all of it.
    locked = np.abs(m[..., 1, 2]) > 1.0 - 1e-12
    yaw = np.where(locked, np.arctan2(-m[..., 2, 0], m[..., 0, 0]), np.arctan2(m[..., 0, 2], m[..., 2, 2]))
    roll = np.where(locked, 0.0, np.arctan2(m[..., 1, 0], m[..., 1, 1]))
    return np.stack([yaw, pitch, roll], axis=-1)


_READ = {
    "axis_angle": _from_axis_angle,
    "axis_angle_x": _from_x,
    "six_d": _from_six,
    "quaternion": _unit,
    "euler": _from_euler,
}
_WRITE = {
    "axis_angle": _to_axis_angle,
    "axis_angle_x": lambda quaternions: _to_axis_angle(quaternions)[..., :1],
    "six_d": _to_six,
    "quaternion": lambda quaternions: np.where(quaternions[..., :1] < 0, -quaternions, quaternions),
    "euler": _to_euler,
}
