"""How the skin is cut into quads: one grid over the left half, with holes for mouth, eye, nostril and ear.

The grid runs from the middle of the face to the back of the head, and from the neck to the crown. At a hole it is cut
open along a rectangle of cells, and its border is moved onto a curve round the feature; loops of quads from that border
inwards make the feature (:mod:`facediff.synthetic.head.parts`). So every loop round mouth and eyes is closed, as a
modeller would lay it, and vertices with more or fewer than four edges lie at the corners of the rectangles only.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from facediff.synthetic.geometry import Array, through
from facediff.synthetic.head.surface import TOP, level_of, plane_of

Index = NDArray[np.int64]

COLUMNS, ROWS = 26, 52
"""Cells of the grid, round the head and upwards."""

# Holes by their first and last column, first and last row.
_HOLES = {"mouth": (0, 8, 17, 21), "eye": (4, 12, 32, 36), "nostril": (1, 3, 24, 26), "ear": (17, 20, 27, 34)}

MOUTH_HALF_WIDTH = 25.0
MOUTH_Y = -46.0
INNER_CANTHUS, OUTER_CANTHUS = np.array([16.5, 23.6]), np.array([45.0, 26.4])
MOUTH_POINTS, EYE_POINTS = 21, 24
"""Vertices of a loop round the left half of the mouth, midline to midline, and of a loop round an eye."""
MOUTH_MARGIN, EYE_MARGIN = 9.0, 8.0
"""Distance in mm of the holes' borders from lips and lids."""

SHIRT_ROWS = 4  # Rows of vertices that the shirt covers
# Heights in mm of the grid's rows on the front midline; rows 18 to 20 end at the mouth. The shirt reaches up
# to row 3.
_BELOW = (-215, -196, -180, -168.5, -166, -152, -139, -126, -112, -103.5, -98, -93.5, -89, -84, -79, -73.5, -68)
_NOSE = (-30.5, -27, -24.5, -21.5, -17.5, -12.5, -6.5, 0.5, 7.5, 14.5, 21.0)
# Columns of the rows over the nose, as distances from the midline: they hold its back and wings in place.
_NOSE_COLUMNS: dict[int, tuple[float, ...]] = {
    23: (4.2, 8.5, 13.5, 19, 25),
    24: (3.6, 7.4, 11.6, 17.2, 23.5),
    25: (3.4, 8.0, 13.0, 18.0, 23.6),
    26: (3.8, 8.0, 13.2, 18.4, 23.8),
    27: (3.8, 7.8, 12.4, 17.4, 23.4),
    28: (3.8, 7.6, 11.8, 16.4, 22.6),
    29: (3.6, 7.2, 11, 15.6, 21.6),
    30: (3.3, 6.6, 10.2, 14.6),
    31: (3.0, 6.0, 9.0, 13.0),
}
_EAR_CENTRE, _EAR_HEIGHT, _EAR_SIZE = 1.70, -8.0, (0.15, 27.0)
_PLANE_RADIUS = 70.0  # mm by which an angle is multiplied, so that both coordinates of the plane are lengths


@dataclass(frozen=True)
class Layout:
    """The grid over the left half of the skin.

    Attributes:
        plane: angle round the head and level of each vertex, (n, 2).
        quads: (q, 4), counter-clockwise seen from outside.
        holes: the vertices round each hole. ``mouth`` runs from the upper midline over the corner to the lower one;
            the others are closed and begin in the middle of the side that faces the midline, upwards first.
        top: the vertices of the last row, from the front midline to the back.
        shirt: the vertices of the first rows, which a shirt covers.
    """

    plane: Array
    quads: Index
    holes: dict[str, Index]
    top: Index
    shirt: Index


def contact_line(x: Array) -> Array:
    """Height in mm at which the lips meet."""
    return MOUTH_Y + through([-6, 0, 6, 14, 25], [0.2, -0.5, 0.2, 0.2, 0.0], x)


def mouth_ring(distance: float) -> Array:
    """Outline of the lips, or a curve at a distance outside it, as (x, y) in mm, shape (21, 2)."""
    share = np.linspace(0.0, 1.0, MOUTH_POINTS // 2 + 1)
    x = MOUTH_HALF_WIDTH * np.sin(0.5 * np.pi * share) ** 0.92
    upper = through([-5.5, 0, 5.5, 12, 19, 23.5, 25], [8.0, 6.8, 8.0, 6.6, 3.8, 2.0, 0.5], x)
    lower = through([-8, 0, 8, 16, 22, 24, 25], [9.4, 9.9, 9.4, 6.6, 3.2, 1.8, 0.5], x)
    turn = 0.5 * np.pi * share**1.15
    across, middle = x + distance * np.sin(turn), contact_line(x)
    top = np.stack([across, middle + upper + distance * np.cos(turn)], axis=1)
    bottom = np.stack([across, middle - lower - distance * np.cos(turn)], axis=1)
    return np.concatenate([top, bottom[-2::-1]])


def eye_ring(distance: float) -> Array:
    """Outline of the eye's opening, or a curve at a distance outside it, as (x, y) in mm, shape (24, 2)."""
    half = EYE_POINTS // 2
    even = np.arange(half + 1) / half
    share = 0.275 * (1.0 - np.cos(np.pi * even)) + 0.45 * even  # denser at the corners, where the outline bends
    line = INNER_CANTHUS + share[:, None] * (OUTER_CANTHUS - INNER_CANTHUS)
    top, bottom = line.copy(), line.copy()
    top[:, 1] += 5.5 * np.sin(np.pi * share**0.9) ** 0.8
    bottom[:, 1] -= 4.5 * np.sin(np.pi * share**1.12) ** 0.8
    turn = 2.0 * np.pi * np.arange(EYE_POINTS) / EYE_POINTS
    away = np.stack([-np.cos(turn), np.sin(turn)], axis=1)
    away[:, 0] *= np.where(away[:, 0] < 0, 0.62, 0.95)  # the nose leaves less room than the temple
    return np.concatenate([top, bottom[-2:0:-1]]) + distance * away


@lru_cache(maxsize=1)
def lay_out() -> Layout:
    """Place and connect the vertices of the left half of the skin."""
    fixed = _held()
    quads = np.array(
        [
            (_at(column, row), _at(column + 1, row), _at(column + 1, row + 1), _at(column, row + 1))
            for row in range(ROWS)
            for column in range(COLUMNS)
            if not any(c0 <= column < c1 and r0 <= row < r1 for c0, c1, r0, r1 in _HOLES.values())
        ]
    )
    plane = _relaxed(quads, fixed)
    indices = np.unique(quads)
    number = np.full((COLUMNS + 1) * (ROWS + 1), -1)
    number[indices] = np.arange(len(indices))
    holes = {name: number[_border(name)] for name in _HOLES}
    top = number[[_at(column, ROWS) for column in range(COLUMNS + 1)]]
    shirt = number[: SHIRT_ROWS * (COLUMNS + 1)]
    return Layout(plane[indices], number[quads], holes, top, shirt)


def _at(column: int, row: int) -> int:
    return row * (COLUMNS + 1) + column


def _border(name: str) -> list[int]:
    """The grid's vertices round a hole, in the order that :class:`Layout` describes."""
    first, last, low, high = _HOLES[name]
    over = [_at(column, high) for column in range(first, last)]
    outer = [_at(last, row) for row in range(high, low, -1)]
    if name == "mouth":  # its fourth side is the midline
        return over + outer + [_at(column, low) for column in range(last, first - 1, -1)]
    under = [_at(column, low) for column in range(last, first, -1)]
    middle = (low + high) // 2
    inner = [_at(first, row) for row in range(low, high)]
    return inner[middle - low :] + over + outer + under + inner[: middle - low]


def _held() -> dict[int, tuple[float, float]]:
    """Vertices with a given place in the plane: the grid's edges, the borders of holes, and the nose."""
    heights = dict(enumerate(_BELOW))
    border = mouth_ring(MOUTH_MARGIN)
    heights[17], heights[21] = border[-1, 1], border[0, 1]
    heights |= dict(zip(range(22, 33), _NOSE, strict=True))
    heights |= dict(zip(range(33, 41), np.linspace(27, 60, 8), strict=True))
    heights |= dict(zip(range(41, ROWS + 1), np.linspace(67.0, 132.0, ROWS - 40), strict=True))
    end = TOP - 1.0  # the crown itself is one vertex, which no grid reaches
    fixed = {_at(0, row): (0.0, float(level_of(height))) for row, height in heights.items()}
    first = float(level_of(heights[SHIRT_ROWS + 1]))
    back = np.linspace(first, end, ROWS - SHIRT_ROWS)
    fixed |= {_at(COLUMNS, row): (np.pi, level) for row, level in enumerate(back.tolist(), start=SHIRT_ROWS + 1)}
    # Cells are narrow in the face and wide at the back.
    angles = np.pi * np.interp(np.arange(COLUMNS + 1), [0, 12, 17, 20, 26], [0, 0.30, 0.46, 0.58, 1.0])
    for column, angle in enumerate(angles):
        fixed[_at(column, ROWS)] = angle, end
        fixed |= {_at(column, row): (angle, float(level_of(heights[row]))) for row in range(SHIRT_ROWS + 2)}
    for name, outline in (("mouth", border), ("eye", eye_ring(EYE_MARGIN))):
        fixed |= dict(zip(_border(name), map(tuple, plane_of(outline).tolist()), strict=True))
    for row, columns in _NOSE_COLUMNS.items():
        # The lowest rows rise towards the cheek, as the base of the nose does.
        lift = np.interp(np.arange(1, len(columns) + 1), [3, 4, 5], [0.0, 0.6, 1.5]) * (row <= 25)
        positions = plane_of(np.stack([np.array(columns), heights[row] + lift], axis=1))
        for column, position in enumerate(positions.tolist(), start=1):
            fixed.setdefault(_at(column, row), (position[0], position[1]))
    turn = 2.0 * np.pi * np.arange(len(_border("ear"))) / len(_border("ear"))
    level = float(level_of(_EAR_HEIGHT))
    for vertex, angle in zip(_border("ear"), turn, strict=True):
        fixed[vertex] = (_EAR_CENTRE - _EAR_SIZE[0] * np.cos(angle), level + _EAR_SIZE[1] * np.sin(angle))
    return fixed


def _relaxed(quads: Index, fixed: dict[int, tuple[float, float]]) -> Array:
    """Put every other vertex into the middle of its neighbours (Tutte's embedding, which cannot fold)."""
    count = (COLUMNS + 1) * (ROWS + 1)
    joined = np.zeros((count, count), dtype=bool)
    for start, end in zip(quads.T, np.roll(quads, -1, axis=1).T, strict=True):
        joined[start, end] = joined[end, start] = True
    system = np.diag(joined.sum(axis=1).astype(np.float64)) - joined
    right = np.zeros((count, 2))
    isolated = ~joined.any(axis=1)
    for vertex in (*fixed, *np.flatnonzero(isolated).tolist()):
        system[vertex] = 0.0
        system[vertex, vertex] = 1.0
        angle, level = fixed.get(vertex, (0.0, 0.0))
        right[vertex] = _PLANE_RADIUS * angle, level
    positions = np.linalg.solve(system, right)
    positions[:, 0] = np.clip(positions[:, 0] / _PLANE_RADIUS, 0.0, np.pi)
    return positions
