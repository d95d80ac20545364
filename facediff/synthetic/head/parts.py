"""The average head: the skin with lips, lids, nostrils and ears, and eyeballs, lashes, brows, teeth, tongue and hair.

Every part is a stack of loops of vertices that are joined by quads. Lengths are in mm.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from facediff.synthetic.geometry import Array, bump, rise, through
from facediff.synthetic.head.hair import HAIR_COLUMNS, HAIR_ROWS, hair_points, strands
from facediff.synthetic.head.layout import (
    EYE_POINTS,
    INNER_CANTHUS,
    MOUTH_HALF_WIDTH,
    MOUTH_POINTS,
    OUTER_CANTHUS,
    Layout,
    contact_line,
    eye_ring,
    lay_out,
    mouth_ring,
)
from facediff.synthetic.head.mesh import HalfQuadMesh, QuadMesh
from facediff.synthetic.head.surface import skin, skin_at

EYE_CENTRE = np.array([31.0, 25.0, 62.5])
EYE_RADIUS = 12.2
"""Radius of the eyeball in mm, as of adults' eyes."""

SKIN, LIP, GUM, TOOTH = (222, 174, 150), (188, 106, 102), (196, 110, 108), (238, 232, 218)
_MOUTH, _THROAT, _TONGUE = (132, 58, 58), (38, 12, 14), (192, 104, 104)
_LID_EDGE, _BEHIND_LIDS, _LASH, _LASH_LINE = (206, 140, 126), (196, 120, 110), (46, 32, 28), (112, 74, 64)
SHIRT = (92, 108, 128)
HAIR, _CROWN = (78, 54, 42), (0.0, 132.8, 0.0)

LIP_LOOPS = ("lip_outer", "lip_crest", "lip_front", "lip_inner", "lip_roll", "mouth_front", "mouth_bag", "mouth_back")
"""Loops of the mouth inwards from the border of the lips; upper and lower lip touch at ``lip_inner``."""
AROUND_MOUTH = {"mouth_far": 5.6, "mouth_near": 2.6, "lip_border": 0.0}
"""Loops of skin round the mouth, and their distance from the lips in mm."""
AROUND_EYE = {"eye_far": 5.4, "eye_crease": 3.3, "eye_near": 1.6, "eye_edge": 0.0}
"""Loops of skin round the eye, and their distance from the edge of the lids in mm."""
LASHES, BROW_COLUMNS = 15, 15
N_HEAD_VERTICES = 5875
"""Vertices of the head, known without building it."""


@lru_cache(maxsize=1)
def build_head() -> QuadMesh:
    """The average head at rest, eyes open and lips closed."""
    layout, half = lay_out(), HalfQuadMesh()
    _add_skin(half, layout)
    _add_mouth(half, layout)
    _add_eye(half, layout)
    _add_nostril(half, layout)
    _add_ear(half, layout)
    _add_teeth(half)
    _add_tongue(half)
    _add_hair(half)
    _add_brow(half)
    return half.mirrored()


def _add_skin(half: HalfQuadMesh, layout: Layout) -> None:
    """The grid, closed at the crown, and its colours."""
    theta, level = layout.plane.T
    points = skin(theta, level)
    points[(theta == 0.0) | (theta > np.pi - 1e-6), 0] = 0.0
    colours = np.tile(np.array(SKIN, dtype=np.float64), (len(points), 1))
    x, y, z = points.T
    front = rise(z, 20, 60)
    for centre, width, colour, share in (
        ((42, -8), (15, 14), (216, 128, 112), 0.26),  # cheeks
        ((0, -14), (9, 7), (212, 126, 110), 0.28),  # tip of the nose
        ((0, -84), (14, 9), (214, 140, 122), 0.2),  # chin
        ((31, 25), (17, 10), (196, 140, 124), 0.35),  # lids
        ((0, -66), (12, 4), (198, 140, 122), 0.25),  # below the lower lip
    ):
        colours += (share * front * bump(x, y, centre, width))[:, None] * (np.array(colour) - colours)
    covered = layout.shirt
    colours[covered] = SHIRT
    outwards = points[covered] * [1.0, 0.0, 1.0]
    points[covered] += 2.2 * outwards / np.linalg.norm(outwards, axis=1, keepdims=True)
    index = half.add("skin", points, colours)
    half.groups["skin_shirt"] = index[covered]
    half.quads.append(index[layout.quads])
    half.fan(layout.top, int(half.add("crown", [_CROWN], SKIN)[0]), closed=False, clockwise=False)


def _add_mouth(half: HalfQuadMesh, layout: Layout) -> None:
    """Skin round the mouth, lips to the line where they touch, and the mouth behind them."""
    loops = [layout.holes["mouth"]]
    for name, distance in AROUND_MOUTH.items():
        loops.append(half.add(name, skin_at(mouth_ring(distance)), SKIN))
    border = half.at("lip_border")
    x, middle = border[:, 0], contact_line(border[:, 0])
    height = border[:, 1] - middle
    side = np.sign(MOUTH_POINTS // 2 - np.arange(MOUTH_POINTS))  # 1 on the upper lip, -1 on the lower one
    full = np.sqrt(np.clip(1.0 - (x / MOUTH_HALF_WIDTH) ** 2, 0.0, 1.0))  # 0 at the corner, where both become one
    depth = seam_depth(border)
    # Share of the way from the line of contact to the border, lift off that line, how far forward upper and lower lip
    # stand, and width. The lips bulge in the middle and not at the corner, so positive values follow their fullness.
    for name, share, lift, upper, lower, width, colour in (
        ("lip_outer", 0.72, 0.0, 2.2, 2.6, 0.996, LIP),
        ("lip_crest", 0.42, 0.0, 3.6, 4.4, 0.986, LIP),
        ("lip_front", 0.16, 0.0, 3.0, 3.6, 0.974, LIP),
        ("lip_inner", 0.0, 0.0, -0.2, -0.2, 0.962, tuple(0.8 * np.array(LIP))),
        ("lip_roll", 0.0, 0.9, -3.6, -3.8, 0.95, _MOUTH),
        ("mouth_front", 0.0, 4.5, -6.5, -7.0, 0.97, _MOUTH),
        ("mouth_bag", 0.0, 11.0, -16.0, -17.0, 1.15, tuple(0.7 * np.array(_MOUTH))),
        ("mouth_back", 0.0, 13.0, -42.0, -42.0, 1.0, _THROAT),
    ):
        forward = np.where(side > 0, upper, lower)
        forward = np.where(forward > 0, forward * full, forward)
        y = middle + share * height + side * lift * full
        loops.append(half.add(name, np.stack([width * x, y, depth + forward], axis=1), colour))
    half.strips(loops)
    half.lid(loops[-1])


def seam_depth(border: Array) -> Array:
    """Depth (21,) of the surface on which the lips meet: in the middle as their outlines, behind at the corner."""
    upper = border[: MOUTH_POINTS // 2 + 1]
    depths = np.interp([0, 8, 16, 22, 25], upper[:, 0], upper[:, 2]) - [0.0, 0.0, 0.3, 0.8, 1.0]
    depths[0] = 0.5 * (border[0, 2] + border[-1, 2])
    return through([0, 8, 16, 22, 25], depths, border[:, 0])


def _add_eye(half: HalfQuadMesh, layout: Layout) -> None:
    """Lids from the socket to their edge and back behind it, lashes, and the eyeball."""
    loops = [layout.holes["eye"]]
    for name, distance in AROUND_EYE.items():
        front = eye_ring(distance)
        points = skin_at(front)
        # Towards their edge the lids leave the surface of the face and lie on the eyeball.
        onto = rise(distance, 7.5, 0.0)
        points[:, 2] += onto * (_lid_depth(front) - points[:, 2])
        if name == "eye_crease":
            points[2:11, 2] -= 1.6 * np.sin(np.pi * np.linspace(0.05, 0.95, 9))
        if name == "eye_far":  # skin of the upper lid hangs a little over the crease
            points[1:12, 2] += 1.2 * np.sin(np.pi * np.linspace(0.0, 1.0, 11))
        # Between the lashes the upper lid lies in their shadow.
        shadow = {"eye_edge": 0.6, "eye_near": 0.3}.get(name, 0.0) * np.isin(np.arange(EYE_POINTS), np.arange(1, 12))
        loops.append(half.add(name, points, SKIN + shadow[:, None] * (np.array(_LASH) - SKIN)))
    edge = half.at("eye_edge")
    middle = 0.5 * (INNER_CANTHUS + OUTER_CANTHUS)
    inner = edge.copy()
    inner[:, :2] += 0.035 * (middle - edge[:, :2])
    inner = _towards_ball(inner, 1.7)
    line = np.where(np.isin(np.arange(EYE_POINTS), np.arange(2, EYE_POINTS // 2))[:, None], _LASH_LINE, _LID_EDGE)
    loops.append(half.add("lid_edge", inner, line))
    # Lids go on behind their edge, close to the ball, so that no gap opens when they move.
    points = inner.copy()
    points[:, :2] = middle + 1.12 * (inner[:, :2] - middle)
    beside = ((points - EYE_CENTRE)[:, :2] ** 2).sum(axis=1)
    points[:, 2] = EYE_CENTRE[2] + np.sqrt(np.clip((EYE_RADIUS + 0.3) ** 2 - beside, 1.0, None)) - 0.3
    loops.append(half.add("lid_behind", points, _BEHIND_LIDS))
    # They end on the ball, so that no view passes it into the head; at the inner corner that makes the caruncle.
    away = points - EYE_CENTRE + np.array([0.0, 0.0, -2.5])
    away *= (EYE_RADIUS - 0.3) / np.linalg.norm(away, axis=1, keepdims=True)
    loops.append(half.add("lid_end", EYE_CENTRE + away, _BEHIND_LIDS))
    half.strips(loops, closed=True)
    _add_lashes(half, edge)
    _add_eyeball(half)


def _lid_depth(front: Array) -> Array:
    """Depth of the lids at (x, y): an ellipsoid round the eyeball, wider than it, since their corners lie beside it."""
    beside, above = (front - EYE_CENTRE[:2]).T
    return EYE_CENTRE[2] + 13.3 * np.sqrt(np.clip(1.0 - (beside / 18.2) ** 2 - (above / 14.8) ** 2, 0.02, None))


def _towards_ball(points: Array, thickness: float) -> Array:
    """Points moved towards the eye's centre by the lids' thickness, but not into the ball."""
    away = points - EYE_CENTRE
    distance = np.linalg.norm(away, axis=1, keepdims=True)
    closer = np.maximum(distance - thickness, EYE_RADIUS + 0.35)
    return np.where(distance > EYE_RADIUS + 0.5, EYE_CENTRE + away / distance * closer, points)


def lash_places() -> Array:
    """Where the roots of the upper lashes lie along the lid, from 0 at the inner corner to 1, shape (15,)."""
    return np.linspace(0.10, 0.96, LASHES)


def _add_lashes(half: HalfQuadMesh, edge: Array) -> None:
    """Lashes of the upper lid, a long triangle each: two vertices at the root, one at the tip."""
    upper, along = edge[: EYE_POINTS // 2 + 1], np.linspace(0.0, 1.0, EYE_POINTS // 2 + 1)
    for number, position in enumerate(lash_places()):
        roots = [
            np.array([np.interp(min(at, 1.0), along, upper[:, axis]) for axis in range(3)])
            for at in (position, position + 0.022)
        ]
        out = (roots[0] - EYE_CENTRE) / np.linalg.norm(roots[0] - EYE_CENTRE)
        tip = roots[0] + (2.4 + 2.0 * position) * (0.85 * out + np.array([0.75 * (position - 0.4), 0.35, 0.35]))
        index = half.add(f"lash_{number:02d}", [*(root + np.array([0.0, 0.0, 0.05]) for root in roots), tip], _LASH)
        half.quads.append(index[[0, 1, 2, 2]][None])


def _add_eyeball(half: HalfQuadMesh) -> None:
    """Sclera, iris and pupil as rings from behind to the front; the cornea stands out a little over the iris' rim."""
    turn = 2.0 * np.pi * np.arange(20) / 20
    fibres = 1.0 + 0.09 * np.cos(np.pi * np.arange(20)) + 0.05 * np.sin(5.0 * turn)
    rings = []
    for name, degrees, out, colour in (
        ("ball_0", 105.0, 0.0, (206, 172, 164)),
        ("ball_1", 75.0, 0.0, (222, 204, 197)),
        ("ball_2", 48.0, 0.0, (232, 224, 218)),
        ("ball_3", 31.0, 0.05, (224, 220, 216)),
        ("iris_rim", 28.0, 0.25, (70, 92, 98)),
        ("iris_middle", 20.0, -0.2, (96, 128, 132)),
        ("iris_inner", 11.5, -0.3, (60, 80, 84)),
        ("pupil_rim", 9.5, -0.3, (16, 14, 14)),
    ):
        angle, radius = np.deg2rad(degrees), EYE_RADIUS + out
        across, up = -radius * np.sin(angle) * np.cos(turn), radius * np.sin(angle) * np.sin(turn)
        ring = np.stack([across, up, np.full_like(turn, radius * np.cos(angle))], axis=1)
        shade = fibres[:, None] if name == "iris_middle" else np.ones((20, 1))
        rings.append(half.add(name, EYE_CENTRE + ring, shade * np.array(colour)))
    half.strips(rings, closed=True)
    tip = half.add("pupil", [EYE_CENTRE + np.array([0.0, 0.0, EYE_RADIUS - 0.25])], (14, 12, 12))
    half.fan(rings[-1], int(tip[0]))
    # The light that the cornea reflects, above the pupil in both eyes.
    around = np.pi * np.arange(6) / 3.0
    glint = np.stack([np.cos(around), 2.9 + 0.9 * np.sin(around), np.full(6, EYE_RADIUS)], axis=1)
    glint *= (EYE_RADIUS + 0.34) / np.linalg.norm(glint, axis=1, keepdims=True)
    index = half.add("glint", EYE_CENTRE + glint, (255, 255, 255))
    half.quads.append(index[[[0, 1, 2, 3], [0, 3, 4, 5]]])


def _add_nostril(half: HalfQuadMesh, layout: Layout) -> None:
    """An oval hole in the underside of the nose that runs upwards and ends in the dark."""
    loops = [layout.holes["nostril"]]
    rim = half.at("skin")[loops[0]]
    centre, across, along = rim.mean(axis=0), rim[4] - rim[0], rim[2] - rim[6]
    turn = 2.0 * np.pi * np.arange(len(rim)) / len(rim)
    oval = 0.43 * (np.sin(turn)[:, None] * along - np.cos(turn)[:, None] * across)
    for number, (size, inside, colour) in enumerate(
        (
            (1.0, (0.0, 0.2, -0.1), SKIN),
            (0.82, (0.0, 1.2, -0.4), (142, 86, 74)),
            (0.62, (0.3, 5.0, -2.5), (58, 27, 25)),
            (0.3, (0.5, 9.0, -5.0), (24, 10, 10)),
        )
    ):
        loops.append(half.add(f"nostril_{number}", centre + size * oval + np.array(inside), colour))
    half.strips(loops, closed=True)
    half.lid(loops[-1])


def _add_ear(half: HalfQuadMesh, layout: Layout) -> None:
    """A shell that is attached in front: its back, the rim, the hollow between rim and antihelix, and the concha."""
    loops = [layout.holes["ear"]]
    turn = 2.0 * np.pi * np.arange(len(loops[0])) / len(loops[0])
    front = half.at("skin")[loops[0]].mean(axis=0) + np.array([0.5, 0.0, 15.0])
    up = 29.0 * np.sin(turn) * (1.0 + 0.08 * np.sin(turn))
    back = (17.0 - 17.0 * np.cos(turn)) * (1.0 - 0.36 * rise(-np.sin(turn), 0.0, 1.0))  # the lobe is narrow
    attached = rise(np.cos(turn), 0.35, 0.95)
    flare, tilt = np.deg2rad(28.0), np.deg2rad(14.0)
    for name, size, out, closer, shift, shade in (
        ("ear_stalk", 0.80, -4.5, 0.5, (0.0, 0.0), 1.0),
        ("ear_behind", 0.97, -2.0, 0.8, (0.0, 0.0), 1.0),
        ("ear_rim", 1.0, 1.6, 1.2, (0.0, 0.0), 1.0),
        ("ear_helix", 0.9, 2.6, 1.2, (0.0, 0.0), 1.0),
        ("ear_scapha", 0.78, -0.6, 1.0, (0.0, 0.0), 0.93),
        ("ear_antihelix", 0.62, 2.0, 0.8, (-1.0, 0.0), 1.0),
        ("ear_concha", 0.42, -4.5, -4.5, (-4.0, -5.0), 0.86),
        ("ear_canal", 0.14, -8.0, -8.0, (-8.0, -6.0), 0.5),
    ):
        outwards = out + (closer - out) * attached
        backwards, upwards = size * (back - 17.0) + 17.0 + shift[0], size * up + shift[1]
        backwards, upwards = (
            backwards * np.cos(tilt) + 0.35 * upwards * np.sin(tilt),
            upwards * np.cos(tilt) - 0.2 * backwards * np.sin(tilt) + 2.0,
        )
        x = backwards * np.sin(flare) + outwards * np.cos(flare)
        z = outwards * np.sin(flare) - backwards * np.cos(flare)
        loops.append(half.add(name, front + np.stack([x, upwards, z], axis=1), shade * np.array(SKIN)))
    half.strips(loops, closed=True)
    half.lid(loops[-1])


def _add_teeth(half: HalfQuadMesh) -> None:
    """Two arches with gums; every second column lies between two teeth."""
    columns = 15
    turn = np.linspace(0.0, np.deg2rad(68.0), columns)
    normal = np.stack([np.sin(turn), np.zeros(columns), np.cos(turn)], axis=1)
    front = float(seam_depth(half.at("lip_border"))[0]) - 6.0
    arch = np.stack([25.0 * np.sin(turn), np.zeros(columns), front - 37.5 * (1.0 - np.cos(turn))], axis=1)
    between = (np.arange(columns) % 2 == 0).astype(np.float64)
    white, inside = np.array(TOOTH, dtype=np.float64), 0.8 * np.array(TOOTH)
    # Height, distance from the arch, depth of the grooves between teeth, colour; front to back over the biting edge.
    upper = (
        ("gum_root", -34.0, -1.5, 0.0, GUM),
        ("gum", -38.5, 0.2, 0.0, GUM),
        ("neck", -39.5, 0.1, 0.5, white),
        ("middle", -44.0, 0.7, 0.7, white),
        ("edge", -48.3, 0.2, 0.5, white),
        ("inside", -48.0, -1.6, 0.0, 0.9 * white),
        ("back", -39.0, -3.5, 0.0, inside),
        ("gum_back", -34.0, -4.0, 0.0, GUM),
    )
    lower = (
        ("gum_root", -63.0, -2.5, 0.0, GUM),
        ("gum", -57.0, -1.8, 0.0, GUM),
        ("neck", -56.0, -1.9, 0.4, white),
        ("middle", -52.0, -1.6, 0.6, white),
        ("edge", -48.3, -2.2, 0.4, white),
        ("inside", -48.6, -3.4, 0.0, 0.9 * white),
        ("back", -58.0, -5.0, 0.0, inside),
        ("gum_back", -66.0, -5.5, 0.0, GUM),
    )
    for jaw, rows, sign in (("upper", upper, 1.0), ("lower", lower, -1.0)):
        loops = []
        for name, height, out, groove, colour in rows:
            points = arch + normal * (out - groove * between)[:, None]
            points[:, 1] = height + (0.7 * sign * between if name == "edge" else 0.0)
            # Little light reaches the back of the mouth.
            dark = 1.0 - 0.6 * rise(turn, np.deg2rad(15.0), np.deg2rad(60.0))
            loops.append(half.add(f"teeth_{jaw}_{name}", points, dark[:, None] * np.array(colour)))
        # From the gum in front to the gum behind, the upper arch's loops follow one another downwards.
        half.strips(loops[::-1], clockwise=jaw == "lower")


def _add_tongue(half: HalfQuadMesh) -> None:
    """A tongue at rest behind the lower teeth: cross sections from tip to root, with a furrow."""
    front = float(seam_depth(half.at("lip_border"))[0]) - 13.0
    turn = np.linspace(0.0, np.pi, 8)  # from the middle of the back round the edge to the middle underneath
    loops = []
    for number, position in enumerate(np.linspace(0.0, 1.0, 9)):
        width = 15.5 * np.sqrt(np.clip(1.0 - (1.0 - min(position / 0.45, 1.0)) ** 2, 0.04, 1.0))
        thickness = 2.2 + 4.5 * np.sin(0.8 * np.pi * min(0.15 + position, 1.0))
        height = -53.1 + 6.0 * np.sin(np.pi * (0.15 + 0.7 * position))
        x, on_top = width * np.sin(turn), np.cos(turn) > 0
        y = height + thickness * np.cos(turn) * np.where(on_top, 0.55, 1.0)
        y -= 1.2 * np.exp(-((x / 3.0) ** 2)) * on_top
        points = np.stack([x, y, np.full_like(x, front - 42.0 * position)], axis=1)
        points[[0, -1], 0] = 0.0
        loops.append(half.add(f"tongue_{number}", points, _TONGUE))
    half.strips(loops, clockwise=False)


def _add_hair(half: HalfQuadMesh) -> None:
    """The shell of hair, in the first style of :data:`facediff.synthetic.head.hair.HairStyle`."""
    points, top = hair_points("short")
    shade = 0.92 + 0.22 * strands()
    grid = half.add("hair", points, shade[:, None] * np.array(HAIR)).reshape(HAIR_ROWS, HAIR_COLUMNS)
    half.strips(list(grid[::-1]))
    crown = half.add("hair_crown", [top], 0.92 * np.array(HAIR))
    half.fan(grid[-1], int(crown[0]), closed=False, clockwise=False)


def _add_brow(half: HalfQuadMesh) -> None:
    """A thin ribbon on the skin; its rims and its ends are half as dense as its middle."""
    share = np.linspace(0.0, 1.0, BROW_COLUMNS)
    x = 11.5 + 36.5 * share
    y = through([10, 20, 30, 39, 49], [39.6, 42.2, 44.4, 44.2, 39.0], x)
    thickness = through([0.0, 0.08, 0.3, 0.65, 1.0], [1.7, 2.6, 2.7, 1.9, 0.4], share)
    rows = []
    for row, (off, lift) in enumerate(((-1.0, 0.1), (-0.55, 0.55), (0.45, 0.75), (1.0, 0.1))):
        lean = 0.9 * off * (1.0 - share)  # the upper rim lies further out, as the hairs do
        points = skin_at(np.stack([x + lean, y + off * thickness], axis=1))
        points[:, 2] += lift
        rows.append(half.add(f"brow_{row}", points, HAIR))
    half.strips(rows[::-1])
