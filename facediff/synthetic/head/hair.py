"""Hair: one shell of strands from the hairline to the crown, which every style shapes in its own way. Lengths in mm.

The columns of its grid run round the head as in the skin, its rows from the hairline upwards. A style says how
thick the shell is, and where it falls below the hairline and how far.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from facediff.synthetic.geometry import Array, bump, rise, through
from facediff.synthetic.head.surface import TOP, level_at, skin

HairStyle = Literal["short", "cropped", "bald", "bob", "long", "bun"]


@dataclass(frozen=True)
class _Cut:
    """The shape of a style: how far the hair stands off, in mm."""

    top: float
    sides: float  # And the back
    quiff: float = 0.0  # More than that, over the forehead
    falls: tuple[float, float] | None = None  # Angles between which it begins to fall below the hairline
    end: float = 0.0  # Height at which falling hair ends
    over_ears: float = 0.0
    knot: float = 0.0  # At the back of the head


_CUTS: dict[HairStyle, _Cut] = {
    "short": _Cut(11.0, 5.0, quiff=6.0),
    "cropped": _Cut(3.2, 2.0),
    "bald": _Cut(-3.0, -3.0),
    "bob": _Cut(13.0, 11.0, falls=(0.86, 1.25), end=-62.0, over_ears=17.0),
    "long": _Cut(12.0, 8.0, quiff=2.0, falls=(1.8, 2.0), end=-122.0),
    "bun": _Cut(7.0, 6.0, quiff=1.0, knot=24.0),
}
_THETA = np.interp(np.arange(37), [0, 9, 24, 36], [0.0, 0.8, 2.1, np.pi])
_SHARE = np.array([0.0, 0.015, 0.045, 0.09, 0.15, 0.22, 0.30, 0.40, 0.50, 0.61, 0.72, 0.84, 0.95])
HAIR_COLUMNS, HAIR_ROWS = len(_THETA), len(_SHARE)
_BELOW = 16.0  # Height below which falling hair no longer follows the skull


def hairline(theta: Array) -> Array:
    """Height at which the hair begins, by the angle round the head: forehead, temple, sideburn, over the ear, nape."""
    front = [(0, 81.5), (0.3, 83), (0.55, 80.5), (0.75, 71), (0.9, 58), (1.02, 46), (1.15, 37), (1.27, 26), (1.37, 4)]
    ear = [(1.46, 0), (1.54, 22), (1.62, 37), (1.72, 40), (1.84, 37), (1.94, 18), (2.02, -6)]
    angles, heights = zip(*front, *ear, (2.15, -32), (2.45, -50), (3.2, -60), strict=True)
    return through(angles, heights, theta)


def strands() -> Array:
    """How far each strand lies above (positive) or below its neighbours, about -1 to 1, for all vertices (n,)."""
    column = np.arange(HAIR_COLUMNS)
    height = 0.5 * np.cos(np.pi * column) + 0.35 * np.sin(2.4 * column) + 0.3 * np.sin(0.9 * column + 1.0)
    height[[0, -1]] *= 0.3
    # They run together at the crown and lie flat at the hairline.
    return np.outer(rise(_SHARE, 0.0, 0.1) * rise(_SHARE, 1.0, 0.6), height).ravel()


def density(style: HairStyle) -> Array:
    """How much of the skin the hair hides at each vertex of the grid (n,): less at the hairline, all of it above."""
    cut = _CUTS[style]
    fall = np.zeros(HAIR_COLUMNS) if cut.falls is None else rise(_THETA, *cut.falls)
    edge = np.interp(np.arange(HAIR_ROWS), [0, 1, 2, 3], [0.3, 0.6, 0.85, 1.0])
    return np.asarray(np.maximum(edge[:, None], fall)).ravel()


def hair_points(style: HairStyle) -> tuple[Array, Array]:
    """The shell on the average head: its grid, row by row from the hairline, (n, 3), and the crown (3,)."""
    cut = _CUTS[style]
    fall = np.zeros(HAIR_COLUMNS) if cut.falls is None else rise(_THETA, *cut.falls)
    edge, end = hairline(_THETA), TOP - 1.0
    lowest = np.where(fall > 0.0, np.minimum(edge, _BELOW), edge)
    start, leaves = level_at(_THETA, edge), level_at(_THETA, lowest)
    # The way from the crown down: over the skull, and then straight.
    length = (1.0 - fall) * (end - start) + fall * (end - leaves + lowest - cut.end)
    way = np.outer(1.0 - _SHARE, length)
    hanging = np.maximum(way - (end - leaves), 0.0)
    theta = np.tile(_THETA, (HAIR_ROWS, 1))
    points = skin(theta, end - way + hanging)
    inside = _SHARE[:, None] * length
    up = rise(points[..., 1], 50.0, 125.0)
    thickness = cut.sides + (cut.top - cut.sides) * up
    thickness += cut.quiff * bump(theta, inside, (0.0, 34.0), (0.8, 20.0))
    thickness += cut.over_ears * bump(theta, points[..., 1], (1.66, 10.0), (0.42, 34.0))
    if cut.top > 0.0:  # the edge lies below the skin, so that the hairline is where both surfaces cross
        slope = 7.0 + 11.0 * rise(theta, 0.9, 0.4) + 20.0 * rise(theta, 1.9, 2.4) * (1.0 - fall)
        thickness = -1.0 + (thickness + 1.0) * (1.0 - np.exp(-inside / slope))
        thickness += 0.11 * thickness.clip(0.0, 9.0) * strands().reshape(thickness.shape)
        # Ends of hair that falls stand off the skin, too.
        thickness = np.maximum(thickness, fall * (cut.sides + 1.0) - 1.0)
    normal = points / np.array([75.0, 140.0, 95.0]) ** 2
    normal[..., 1] *= rise(points[..., 1], 0.0, 60.0)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    points = points + thickness[..., None] * normal
    inwards = 1.0 - 0.05 * hanging / max(_BELOW - cut.end, 1.0)
    points *= np.stack([inwards, np.ones_like(inwards), inwards], axis=-1)
    points[..., 1] -= hanging
    knot = np.sqrt(np.clip(1.0 - ((points[..., 1] - 56.0) / 34.0) ** 2 - ((theta - np.pi) / 0.5) ** 2, 0.0, 1.0))
    points += (cut.knot * knot)[..., None] * np.array([0.0, 0.25, -1.0])
    points[:, [0, -1], 0] = 0.0
    crown = np.array([0.0, 132.8 + (cut.top if cut.top < 0 else cut.top + 0.3), 0.0])
    return points.reshape(-1, 3), crown
