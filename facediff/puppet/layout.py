"""Where the vertices of the skin lie: rings round mouth and eyes, rows on nose and brows, an even fill.

Points live in the plane of (length round the head, level), in mm, where the skin is hardly distorted. Only
the left half is laid out; points on the midline have length 0.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facediff.puppet.curves import Array, rise, through
from facediff.puppet.surface import HIGHEST_LEVEL, LOWEST_LEVEL, MOUTH_Y, locate, radius
from facediff.puppet.triangulate import delaunay

LIP_COLUMNS = np.array([0.0, 4.2, 8.2, 12.0, 15.8, 19.4, 22.5, 25.0])
MOUTH_HALF_WIDTH = 25.0
EYE_COLUMNS = np.array([0.07, 0.2, 0.35, 0.5, 0.65, 0.8, 0.93])
BROW_COLUMNS = np.array([13.0, 19.5, 27.0, 34.5, 42.0, 48.5])
_INNER_CANTHUS, _OUTER_CANTHUS = np.array([17.0, 23.8]), np.array([45.5, 26.2])
_NOSE_ROWS: dict[float, tuple[float, ...]] = {
    32.0: (0.0, 6.0),
    23.0: (0.0, 5.0),
    14.0: (0.0, 5.0, 10.0),
    5.0: (0.0, 5.0, 10.5),
    -3.0: (0.0, 5.5, 10.5, 16.0),
    -9.0: (0.0, 5.0, 10.0, 14.5, 20.0),
    -14.0: (0.0, 5.5, 10.5, 15.0, 20.0),
    -18.5: (0.0, 4.0, 8.5, 13.5, 18.0, 22.5),
    -23.0: (0.0, 4.5, 9.5, 15.0),
}


@dataclass(frozen=True)
class Layout:
    """The left half of the skin before it is put into space.

    Attributes:
        theta: Angle round the head of every point, shape (n,).
        level: Level of every point, shape (n,).
        triangles: Indices of points, counter-clockwise, shape (m, 3).
        rings: Named index lists: ``mouth_0`` (the lips' outer border) to ``mouth_2``, from the upper midline
            over the corner to the lower midline; ``eye_0`` (the lids' edge) to ``eye_2``, from the inner
            corner over the upper lid; ``brow`` (middle line of the brow).
    """

    theta: Array
    level: Array
    triangles: NDArray[np.int64]
    rings: dict[str, list[int]]


def contact_line(x: Array) -> Array:
    """Height in mm of the line where the lips meet."""
    return MOUTH_Y + through([0, 6, 14, 25], [-0.8, 0.1, 0.1, 0.2], x)


def mouth_ring(distance: float) -> Array:
    """Closed outline of the lips, or a curve at a distance outside, as (x, y) in mm, shape (15, 2)."""
    upper = through([0, 5.5, 12, 19, 25], [6.6, 8.2, 6.4, 3.2, 0.0], LIP_COLUMNS)
    lower = through([0, 8, 16, 25], [9.2, 8.6, 5.6, 0.0], LIP_COLUMNS)
    turn = 0.5 * np.pi * LIP_COLUMNS / MOUTH_HALF_WIDTH
    x = LIP_COLUMNS + distance * np.sin(turn)
    middle = contact_line(LIP_COLUMNS)
    top = np.stack([x, middle + upper + distance * np.cos(turn)], axis=1)
    bottom = np.stack([x, middle - lower - distance * np.cos(turn)], axis=1)
    return np.concatenate([top, bottom[-2::-1]])


def eye_ring(distance: float) -> Array:
    """Closed outline of the eye's opening, or a curve outside it, as (x, y) in mm, shape (16, 2)."""
    t = EYE_COLUMNS[:, None]
    line = _INNER_CANTHUS + t * (_OUTER_CANTHUS - _INNER_CANTHUS)
    up = np.array([0.0, 1.0])
    top = line + up * 6.2 * np.sin(np.pi * t**0.92) ** 0.75
    bottom = line - up * 4.3 * np.sin(np.pi * t**1.1) ** 0.75
    ring = np.concatenate([_INNER_CANTHUS[None], top, _OUTER_CANTHUS[None], bottom[::-1]])
    centre = 0.5 * (_INNER_CANTHUS + _OUTER_CANTHUS)
    away = (ring - centre) / np.array([14.0, 8.0])
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    squeeze = np.where(away[:, :1] < 0, 1.0 - 0.45 * np.abs(away[:, :1]), 1.0)
    return np.asarray(ring + distance * away * squeeze)


def brow_line(x: Array) -> Array:
    """Height in mm of the middle of the brow."""
    return through([8, 20, 36, 50], [40.5, 43.5, 45.0, 39.5], x)


def hairline(theta: Array) -> Array:
    """Level at which the hair begins, going round the head."""
    return through([0, 0.35, 0.7, 1.0, 1.2, 1.5, 1.9, 3.2], [88, 88, 76, 56, 34, 12, -12, -52], theta)


def spacing(theta: Array, level: Array) -> Array:
    """Wanted distance between neighbouring points, in mm."""
    round_head = through([0, 0.8, 1.3, 1.9, 3.2], [10, 11.5, 17, 27, 33], theta)
    height = 1.0 + 0.9 * rise(level, 55.0, 110.0) + 1.1 * rise(level, -88.0, -115.0)
    return np.minimum(round_head * height, 34.0)


def lay_out() -> Layout:
    """Place and connect the points of the left half of the skin."""
    features, rings = _features()
    points = [tuple(point) for point in features]
    points += _edges(np.array(points))
    fixed = len(points)
    points += _fill(np.array(points))
    places = _relax(np.array(points), fixed)
    triangles = _cut(places, delaunay(places))
    theta = np.clip(places[:, 0] / radius(places[:, 1]), 0.0, np.pi)
    return Layout(theta, places[:, 1], triangles, rings)


def to_plane(front: Array) -> Array:
    """Turn places (x, y) on the front of the head into the plane of the layout."""
    theta, level = locate(front[:, 0], front[:, 1])
    return np.stack([theta * radius(level), level], axis=1)


def _features() -> tuple[Array, dict[str, list[int]]]:
    groups = {f"mouth_{k}": mouth_ring(distance) for k, distance in enumerate((0.0, 4.5, 10.5))}
    groups |= {f"eye_{k}": eye_ring(distance) for k, distance in enumerate((0.0, 3.5, 9.0))}
    brow = np.stack([BROW_COLUMNS, brow_line(BROW_COLUMNS)], axis=1)
    groups["brow"] = brow
    groups["brow_above"] = brow + np.array([0.0, 5.0])
    groups["brow_below"] = brow[:2] - np.array([0.0, 4.5])
    groups["brow_ends"] = np.array([[0.0, 41.0], [7.5, 41.5], [54.0, 37.0]])
    groups["nose"] = np.array([(x, y) for y, row in _NOSE_ROWS.items() for x in row])
    rings: dict[str, list[int]] = {}
    count = 0
    for name, group in groups.items():
        rings[name] = list(range(count, count + len(group)))
        count += len(group)
    theta = np.array([0.0, 0.16, 0.33, 0.5, 0.66, 0.8, 0.93, 1.07, 1.22, 1.38, 1.56, 1.78])
    level = hairline(theta)
    rings["hairline"] = list(range(count, count + len(theta)))
    row = np.stack([theta * radius(level), level], axis=1)
    return np.concatenate([to_plane(np.concatenate(list(groups.values()))), row]), rings


def _edges(features: Array) -> list[tuple[float, float]]:
    """Points on the midline in front and at the back and on the rows that end neck and crown."""
    ends = (LOWEST_LEVEL, HIGHEST_LEVEL)
    front_levels = [*ends, *features[features[:, 0] == 0.0, 1]]
    lips = mouth_ring(0.0)[[-1, 0], 1]
    front = [level for level in _between(sorted(front_levels), 0.0) if not lips[0] < level < lips[1]]
    edge = [(0.0, level) for level in front]
    edge += [(0.0, level) for level in ends]
    # Where nape and crown bend, the outline of the back needs more points than the even spacing gives.
    bends = [LOWEST_LEVEL, -112.0, -96.0, 112.0, 134.0, HIGHEST_LEVEL]
    back = [*bends, *_between(bends, np.pi)]
    edge += [(float(np.pi * radius(level)), level) for level in back]
    for level, parts in ((LOWEST_LEVEL, 5), (HIGHEST_LEVEL, 4)):
        length = float(np.pi * radius(level))
        edge += [(length * k / parts, level) for k in range(1, parts)]
    return edge


def _between(levels: list[float], theta: float) -> list[float]:
    """Levels that divide the gaps between the given ones at the wanted spacing."""
    added: list[float] = []
    for low, high in zip(levels[:-1], levels[1:], strict=True):
        walk = np.linspace(low, high, 65)
        density = 1.0 / spacing(np.full(65, theta), walk)
        reach = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * np.diff(walk))])
        parts = int(np.floor(reach[-1] + 0.45))
        added += [float(level) for level in np.interp(np.arange(1, parts) / max(parts, 1) * reach[-1], reach, walk)]
    return added


def _fill(points: Array) -> list[tuple[float, float]]:
    """Fill what is left, row by row, with points as far apart as `spacing` asks."""
    holes = [to_plane(mouth_ring(0.0)), to_plane(eye_ring(0.0))]
    pitch = 2.5
    taken = points
    wanted = spacing(taken[:, 0] / radius(taken[:, 1]), taken[:, 1])
    new: list[tuple[float, float]] = []
    for row, level in enumerate(np.arange(LOWEST_LEVEL + 6, HIGHEST_LEVEL - 3, pitch)):
        limit = float(np.pi * radius(level))
        for length in np.arange(4.0 + 0.5 * pitch * (row % 2), limit, pitch):
            own = float(spacing(np.array(length / radius(level)), np.array(level)))
            far = np.hypot(taken[:, 0] - length, taken[:, 1] - level)
            nearest = (far / np.minimum(0.5 * (wanted + own), own)).min()
            if nearest < 0.88 or limit - length < 0.5 * own or length < 0.6 * own:
                continue
            if any(_inside(hole, np.array([[length, level]]))[0] for hole in holes):
                continue
            new.append((float(length), float(level)))
            taken = np.concatenate([taken, [[length, level]]])
            wanted = np.append(wanted, own)
    return new


def _inside(outline: Array, places: Array) -> NDArray[np.bool_]:
    """Say which places lie inside a closed outline (crossing number)."""
    first, second = outline[:, None], np.roll(outline, -1, axis=0)[:, None]
    straddles = (first[..., 1] > places[:, 1]) != (second[..., 1] > places[:, 1])
    rising = np.where(second[..., 1] == first[..., 1], 1.0, second[..., 1] - first[..., 1])
    cross = first[..., 0] + (places[:, 1] - first[..., 1]) / rising * (second[..., 0] - first[..., 0])
    return np.asarray((straddles & (cross > places[:, 0])).sum(axis=0) % 2 == 1)


def _relax(places: Array, fixed: int, rounds: int = 6) -> Array:
    """Even out the free points: each moves towards the mean of its neighbours."""
    places = places.copy()
    for _ in range(rounds):
        triangles = delaunay(places)
        total, degree = np.zeros_like(places), np.zeros(len(places))
        for a, b in ((0, 1), (1, 2), (2, 0)):
            np.add.at(total, triangles[:, a], places[triangles[:, b]])
            np.add.at(degree, triangles[:, a], 1.0)
        mean = total / np.maximum(degree, 1.0)[:, None]
        places[fixed:] += 0.6 * (mean - places)[fixed:]
    return places


def _cut(places: Array, triangles: NDArray[np.int64]) -> NDArray[np.int64]:
    """Drop the triangles in the mouth, in the eye and beyond the back of the head."""
    centre = places[triangles].mean(axis=1)
    back = places[places[:, 0] > np.pi * radius(places[:, 1]) - 0.1]
    back = back[np.argsort(back[:, 1])]
    drop = centre[:, 0] > np.interp(centre[:, 1], back[:, 1], back[:, 0]) - 1e-6
    for ring in (mouth_ring(0.0), eye_ring(0.0)):
        drop |= _inside(to_plane(ring), centre)
    kept: NDArray[np.int64] = triangles[~drop]
    return kept
