"""The puppet's neutral head: skin, lips with a mouth behind them, teeth, eyes and ears, all made by code.

Lengths are in millimetres while the head is built and in metres in what :func:`build_face` returns; x points to
the face's left, y up, z to the viewer. Only the left half is built; the other half is its mirror image.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray

from facediff.synthetic.geometry import Array, HalfMesh, HeadMesh, bump, delaunay, rise, through

N_VERTICES = 1008

EYEBALL_RADIUS = 14.0
_SKIN, _HAIR, _BROW, _LIP = (226, 178, 152), (74, 52, 40), (92, 64, 48), (196, 104, 98)
_LID_EDGE, _MOUTH, _THROAT, _TEETH = (120, 76, 62), (132, 58, 56), (30, 10, 12), (240, 235, 222)
_WHITE, _IRIS, _PUPIL, _NOSTRIL = (244, 242, 238), (86, 116, 122), (22, 18, 18), (120, 72, 60)

EYE_CENTRE = (31.0, 25.5, 63.0)
LID_RADIUS = 15.0
MOUTH_Y = -48.0
LOWEST_LEVEL, HIGHEST_LEVEL = -150.0, 150.0

LIP_COLUMNS = np.array([0.0, 4.2, 8.2, 12.0, 15.8, 19.4, 22.5, 25.0])
MOUTH_HALF_WIDTH = 25.0
EYE_COLUMNS = np.array([0.07, 0.2, 0.35, 0.5, 0.65, 0.8, 0.93])
BROW_COLUMNS = np.array([13.0, 19.5, 27.0, 34.5, 42.0, 48.5])


@lru_cache(maxsize=1)
def build_face() -> HeadMesh:
    """Build the neutral head, in metres; speakers' heads have the same faces and other vertices."""
    half = HalfMesh()
    _add_skin(half)
    _add_mouth(half)
    _add_teeth(half)
    _add_lids(half)
    _add_eyeball(half)
    _add_ear(half)
    mesh = half.mirrored()
    return HeadMesh(mesh.vertices / 1000.0, mesh.faces, mesh.colours, mesh.mirror, mesh.groups)


def _add_skin(half: HalfMesh) -> None:
    """Place, connect and colour the skin."""
    theta, level, triangles, rings = lay_out()
    points = skin(theta, level)
    points[theta == 0.0, 0] = 0.0
    points[theta > np.pi - 1e-6, 0] = 0.0
    index = half.add("skin", points, _SKIN)
    half.faces.append(index[triangles])
    top = np.flatnonzero(level == level.max())
    top = top[np.argsort(theta[top])]
    crown = int(half.add("crown", np.array([CROWN]), _HAIR)[0])
    half.faces.append(np.array([[a, b, crown] for a, b in pairwise(top)]))
    for name, ring in rings.items():
        half.groups[name] = index[ring]
    colours = half.colours[0]
    x, y, z = points.T
    line = hairline(theta)
    _mix(colours, rise(level, line + 0.5, line + 8.0), _HAIR)
    blush = 0.30 * bump(x, y, (44, -6), (13, 11)) + 0.25 * bump(x, y, (0, -10), (8, 6))
    _mix(colours, np.where(z > 0, blush, 0.0), (222, 128, 110))
    _mix(colours, np.where(z > 0, bump(x, y, (7.0, -20.5), (2.4, 2.4)), 0.0), _NOSTRIL)
    colours[half.groups["brow"]] = _BROW
    colours[half.groups["mouth_0"]] = 0.75 * np.array(_LIP) + 0.25 * np.array(_SKIN)
    colours[half.groups["eye_0"][1:8]] = _LID_EDGE
    colours[half.groups["eye_0"][9:]] = 0.5 * (np.array(_LID_EDGE) + np.array(_SKIN))


def _mix(colours: Array, share: Array, colour: tuple[int, int, int]) -> None:
    colours += share[:, None] * (np.array(colour, dtype=np.float64) - colours)


def _add_mouth(half: HalfMesh) -> None:
    """Lips from their outer border over the crest to the line of contact, and the mouth behind them."""
    border = half.groups["mouth_0"]
    outline = half.points[0][border]
    # How full the lips are along the chain: zero at the corner, where both become one.
    side = np.sign(np.arange(15) - 7.0)
    x = np.concatenate([LIP_COLUMNS, LIP_COLUMNS[-2::-1]])
    full = np.sqrt(np.clip(1.0 - (x / MOUTH_HALF_WIDTH) ** 2, 0.0, 1.0))
    middle = contact_line(x)
    height = outline[:, 1] - middle
    upper = side < 0
    # The surface on which the lips meet: a little in front of the corners, back where the outline is.
    depth = through(
        [0, 12, 20, 25],
        [
            outline[[0, 14], 2].mean() + 0.6,
            outline[[3, 11], 2].mean() + 0.4,
            outline[[5, 9], 2].mean() - 0.4,
            outline[7, 2] - 0.6,
        ],
        x,
    )

    def loop(
        name: str, dx: float, share: float, lift: Array, forward: Array, colour: tuple[int, int, int]
    ) -> NDArray[np.int64]:
        y = middle + share * height + lift
        z = depth + forward
        return half.add(name, np.stack([x * dx, y, z], axis=1), colour)

    crest = loop("lip_crest", 1.0, 0.55, 0.0 * x, np.where(upper, 2.4, 3.2) * full, _LIP)
    front = loop("lip_front", 0.995, 0.2, 0.0 * x, np.where(upper, 1.4, 1.9) * full, _LIP)
    contact = loop("lip_inner", 0.99, 0.0, 0.0 * x, -1.5 * np.ones(15), tuple(np.array(_LIP) * 9 // 10))
    roll = loop("lip_roll", 0.96, 0.0, -side * 2.0 * full - 0.2 * side, -5.0 - 0.5 * full, _MOUTH)
    bag = loop("mouth_bag", 0.86, 0.0, -side * (8.0 * full), -15.0 - 2.0 * full, tuple(np.array(_MOUTH) * 2 // 3))
    back = loop("mouth_back", 0.7, 0.0, -side * (9.0 * full), -28.0 - 2.0 * full, _THROAT)
    for outer, inner in pairwise((border, crest, front, contact, roll, bag, back)):
        half.strip(outer, inner)
    for i in range(7):
        a, b, c, d = back[i], back[i + 1], back[13 - i], back[14 - i]
        half.faces.append(np.array([[a, d, c], [a, c, b]]) if i < 6 else np.array([[a, d, b]]))


def _add_teeth(half: HalfMesh) -> None:
    """Two curved rows of teeth, each a strip that bends back at gums and edge."""
    columns = np.array([0.0, 6.5, 13.0, 19.0])
    front = float(half.points[0][half.groups["mouth_0"][0], 2]) - 8.5
    arc = front - 14.0 * (columns / 20.0) ** 2
    for name, root, edge, behind in (("teeth_upper", -40.0, -50.2, 0.0), ("teeth_lower", -60.0, -50.8, 2.2)):
        rows = [
            half.add(f"{name}_{k}", np.stack([columns * s, np.full(4, y), arc - back - behind], axis=1), _TEETH)
            for k, (s, y, back) in enumerate(((0.97, root, 1.5), (1.0, edge, 0.0)))
        ]
        outer, inner = rows if root > edge else rows[::-1]
        half.strip(outer, inner)


def _add_lids(half: HalfMesh) -> None:
    """Give the lids a thickness: a ring behind the edge, so that no gap shows round the eyeball."""
    edge = half.groups["eye_0"]
    points = half.points[0][edge]
    centre = points.mean(axis=0)
    shrink = np.full(16, 0.06)
    # The ball is narrower than the opening: at the corners the lids' backs reach in to it.
    shrink[[0, 8]] = 0.2
    inner = points + shrink[:, None] * (centre - points)
    inner[:, 2] = points[:, 2] - 3.0
    half.strip(edge, half.add("lid_inner", inner, (206, 140, 122)), closed=True)


def _add_eyeball(half: HalfMesh) -> None:
    """Front of an eyeball that looks straight ahead."""
    turn = -2.0 * np.pi * (np.arange(10) + 0.5) / 10.0
    rings = []
    for k, (degrees, cornea, colour) in enumerate(
        ((80.0, 0.0, _WHITE), (29.0, 0.2, _WHITE), (26.0, 0.4, _IRIS), (11.5, 0.7, _PUPIL))
    ):
        angle = np.deg2rad(degrees)
        r = EYEBALL_RADIUS + cornea
        across, up = r * np.sin(angle) * np.cos(turn), r * np.sin(angle) * np.sin(turn)
        ring = np.stack([across, up, np.full(10, r * np.cos(angle))], axis=1)
        rings.append(half.add(f"eyeball_{k}", ring + np.array(EYE_CENTRE), colour))
    for outer, inner in pairwise(rings):
        half.strip(outer, inner, closed=True)
    tip = np.array([[EYE_CENTRE[0], EYE_CENTRE[1], EYE_CENTRE[2] + EYEBALL_RADIUS + 0.8]])
    half.fan(rings[-1], int(half.add("pupil", tip, _PUPIL)[0]))


def _add_ear(half: HalfMesh) -> None:
    """A shell next to the head: rim, hollow and lobe."""
    turn = -2.0 * np.pi * np.arange(8) / 8.0
    # Outline in the ear's own plane, (backwards, up) in mm.
    outline = np.stack([-16.0 * np.sin(turn) * (1.0 + 0.18 * np.cos(turn)), 30.0 * np.cos(turn)], axis=1)
    rings = []
    for name, scale, out in (
        ("ear_back", 0.72, -7.0),
        ("ear_rim", 1.0, 1.0),
        ("ear_front", 0.9, 2.6),
        ("ear_valley", 0.68, -1.0),
    ):
        rings.append(half.add(name, _beside_head(outline * scale, out), _SKIN))
    for outer, inner in pairwise(rings):
        half.strip(outer, inner, closed=True)
    centre = half.add("ear_hollow", _beside_head(np.array([[3.0, -4.0]]), -5.0), (190, 130, 110))
    half.fan(rings[-1], int(centre[0]))


def _beside_head(flat: Array, out: float) -> Array:
    """Turn (backwards, up) and a distance outwards, in mm, into a place next to the head."""
    tilt, flare = np.deg2rad(-12.0), np.deg2rad(24.0)
    back = flat[:, 0] * np.cos(tilt) - flat[:, 1] * np.sin(tilt)
    up = flat[:, 0] * np.sin(tilt) + flat[:, 1] * np.cos(tilt)
    x = 79.5 + back * np.sin(flare) + out * np.cos(flare)
    z = -12.0 - back * np.cos(flare) + out * np.sin(flare)
    return np.stack([x, 14.0 + up, z], axis=1)


# Where the vertices of the skin lie: rings round mouth and eyes, rows on nose and brows, an even fill.
#
# Points live in the plane of (length round the head, level), in mm, where the skin is hardly distorted. Points on the
# midline have length 0.

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


def hairline(theta: Array) -> Array:
    """Level at which the hair begins, going round the head."""
    return through([0, 0.35, 0.7, 1.0, 1.2, 1.5, 1.9, 3.2], [88, 88, 76, 56, 34, 12, -12, -52], theta)


def spacing(theta: Array, level: Array) -> Array:
    """Wanted distance between neighbouring points, in mm."""
    round_head = through([0, 0.8, 1.3, 1.9, 3.2], [10, 11.5, 17, 27, 33], theta)
    height = 1.0 + 0.9 * rise(level, 55.0, 110.0) + 1.1 * rise(level, -88.0, -115.0)
    return np.minimum(round_head * height, 34.0)


def lay_out() -> tuple[Array, Array, NDArray[np.int64], dict[str, list[int]]]:
    """Place and connect the points of the left half of the skin.

    Returns:
        the angle round the head and the level of every point, both (n,); triangles (m, 3), counter-clockwise; and named
        lists of points: ``mouth_0`` (the lips' outer border) to ``mouth_2``, from the upper midline over the corner to
        the lower midline; ``eye_0`` (the lids' edge) to ``eye_2``, from the inner corner over the upper lid; ``brow``
        (middle line of the brow) and others.
    """
    features, rings = _features()
    points = [tuple(point) for point in features]
    points += _edges(np.array(points))
    fixed = len(points)
    points += _fill(np.array(points))
    places = _relax(np.array(points), fixed)
    triangles = _cut(places, delaunay(places))
    theta = np.clip(places[:, 0] / radius(places[:, 1]), 0.0, np.pi)
    return theta, places[:, 1], triangles, rings


def to_plane(front: Array) -> Array:
    """Turn places (x, y) in mm on the front of the head, before the relief, into the plane of the layout."""
    across, height = front[:, 0], front[:, 1]
    theta, level = np.zeros_like(across), height.copy()
    for _ in range(30):
        theta = np.arcsin(np.clip(across / _curve(level, 4), 0.0, 1.0))
        level = level + 0.7 * (height - _curve(level, 1) - _curve(level, 6) * _climb(theta))
    return np.stack([theta * radius(level), level], axis=1)


def _features() -> tuple[Array, dict[str, list[int]]]:
    groups = {f"mouth_{k}": mouth_ring(distance) for k, distance in enumerate((0.0, 4.5, 10.5))}
    groups |= {f"eye_{k}": eye_ring(distance) for k, distance in enumerate((0.0, 3.5, 9.0))}
    brow = np.stack([BROW_COLUMNS, through([8, 20, 36, 50], [40.5, 43.5, 45.0, 39.5], BROW_COLUMNS)], axis=1)
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
    edge = [(0.0, level) for level in (*front, *ends)]
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
    for low, high in pairwise(levels):
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
    spacings = spacing(taken[:, 0] / radius(taken[:, 1]), taken[:, 1])
    new: list[tuple[float, float]] = []
    for row, level in enumerate(np.arange(LOWEST_LEVEL + 6, HIGHEST_LEVEL - 3, pitch)):
        limit = float(np.pi * radius(level))
        lengths = np.arange(4.0 + 0.5 * pitch * (row % 2), limit, pitch)
        # The spacing is interpolated for a whole row at a time: point by point it took most of the six seconds that
        # every process which needs the face would wait.
        own_spacings = spacing(lengths / radius(level), np.full_like(lengths, level))
        for length, own in zip(lengths, own_spacings.tolist(), strict=True):
            if limit - length < 0.5 * own or length < 0.6 * own:
                continue
            far = np.hypot(taken[:, 0] - length, taken[:, 1] - level)
            if (far / np.minimum(0.5 * (spacings + own), own)).min() < 0.88:
                continue
            if any(_inside(hole, np.array([[length, level]]))[0] for hole in holes):
                continue
            new.append((float(length), float(level)))
            taken = np.concatenate([taken, [[length, level]]])
            spacings = np.append(spacings, own)
    return new


def _inside(outline: Array, places: Array) -> NDArray[np.bool_]:
    """Which places lie inside a closed outline (crossing number)."""
    first, second = outline[:, None], np.roll(outline, -1, axis=0)[:, None]
    straddles = (first[..., 1] > places[:, 1]) != (second[..., 1] > places[:, 1])
    rising = np.where(second[..., 1] == first[..., 1], 1.0, second[..., 1] - first[..., 1])
    cross = first[..., 0] + (places[:, 1] - first[..., 1]) / rising * (second[..., 0] - first[..., 0])
    return np.asarray((straddles & (cross > places[:, 0])).sum(axis=0) % 2 == 1)


def _relax(places: Array, fixed: int) -> Array:
    """Even out the free points: each moves towards the mean of its neighbours."""
    places = places.copy()
    for _ in range(6):
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


# The skin of the head as a function of two parameters, in millimetres.
#
# The head is a stack of closed horizontal curves: ``theta`` runs round the head from the front midline (0) to the back
# (pi), ``level`` climbs from the neck to the crown and equals the height y in the face. The table gives each curve's
# extent; the face is modelled on top by smooth hills and hollows of `_relief`.

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

    The geometric mean of the true radius and a constant one. The true radius would shear the back of the crown and the
    nape, where it changes fast; a constant one would enlarge the crown.
    """
    true = 0.5 * _curve(level, 4) + 0.25 * (_curve(level, 2) - _curve(level, 5))
    return np.asarray(np.sqrt(82.0 * true))


def _climb(theta: ArrayLike) -> Array:
    return rise(theta, 0.3, 1.4)


def skin(angle: Array, level: Array) -> Array:
    """Positions (n, 3) in mm of points on the skin, by angle round the head, 0 (front) to pi (back), and level."""
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
    """Slight fold from the wing of the nose to the side of the mouth."""
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
