"""The puppet's neutral head: skin, lips with a mouth behind them, teeth, eyes and ears, all made by code.

Lengths are in millimetres while the head is built and in metres in what `build_face` returns; x points to
the face's left, y up, z to the viewer.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from facediff.puppet.curves import Array, bump, rise, through
from facediff.puppet.layout import LIP_COLUMNS, MOUTH_HALF_WIDTH, Layout, contact_line, hairline, lay_out
from facediff.puppet.mesh import HalfMesh, Mesh
from facediff.puppet.surface import CROWN, EYE_CENTRE, skin

N_VERTICES = 1008

EYEBALL_RADIUS = 14.0
_SKIN, _HAIR, _BROW, _LIP = (226, 178, 152), (74, 52, 40), (92, 64, 48), (196, 104, 98)
_LID_EDGE, _MOUTH, _THROAT, _TEETH = (120, 76, 62), (132, 58, 56), (30, 10, 12), (240, 235, 222)
_WHITE, _IRIS, _PUPIL, _NOSTRIL = (244, 242, 238), (86, 116, 122), (22, 18, 18), (120, 72, 60)


@lru_cache(maxsize=1)
def build_face() -> Mesh:
    """Build the neutral head, in metres; speakers' heads have the same faces and other vertices."""
    half = HalfMesh()
    layout = lay_out()
    _add_skin(half, layout)
    _add_mouth(half)
    _add_teeth(half)
    _add_lids(half)
    _add_eyeball(half)
    _add_ear(half)
    mesh = half.mirrored()
    return Mesh(mesh.vertices / 1000.0, mesh.faces, mesh.colours, mesh.mirror, mesh.groups)


def _add_skin(half: HalfMesh, layout: Layout) -> None:
    points = skin(layout.theta, layout.level)
    points[layout.theta == 0.0, 0] = 0.0
    points[layout.theta > np.pi - 1e-6, 0] = 0.0
    index = half.add("skin", points, _SKIN)
    half.faces.append(index[layout.triangles])
    top = np.flatnonzero(layout.level == layout.level.max())
    top = top[np.argsort(layout.theta[top])]
    crown = int(half.add("crown", np.array([CROWN]), _HAIR)[0])
    half.faces.append(np.array([[a, b, crown] for a, b in zip(top[:-1], top[1:], strict=True)]))
    for name, ring in layout.rings.items():
        half.groups[name] = index[ring]
    _paint_skin(half, points, layout)


def _paint_skin(half: HalfMesh, points: Array, layout: Layout) -> None:
    colours = half.colours[0]
    x, y, z = points.T
    line = hairline(layout.theta)
    _mix(colours, rise(layout.level, line + 0.5, line + 8.0), _HAIR)
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
    for outer, inner in (
        (border, crest),
        (crest, front),
        (front, contact),
        (contact, roll),
        (roll, bag),
        (bag, back),
    ):
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
        for outer, inner in zip(rows[:-1], rows[1:], strict=True):
            half.strip(*((outer, inner) if root > edge else (inner, outer)))


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
        ring = np.stack(
            [
                r * np.sin(angle) * np.cos(turn),
                r * np.sin(angle) * np.sin(turn),
                np.full(10, r * np.cos(angle)),
            ],
            axis=1,
        )
        rings.append(half.add(f"eyeball_{k}", ring + np.array(EYE_CENTRE), colour))
    for outer, inner in zip(rings[:-1], rings[1:], strict=True):
        half.strip(outer, inner, closed=True)
    tip = np.array([[EYE_CENTRE[0], EYE_CENTRE[1], EYE_CENTRE[2] + EYEBALL_RADIUS + 0.8]])
    half.fan(rings[-1], int(half.add("pupil", tip, _PUPIL)[0]))


def _add_ear(half: HalfMesh) -> None:
    """A shell beside the head: rim, hollow and lobe."""
    turn = -2.0 * np.pi * np.arange(8) / 8.0
    # Outline in the ear's own plane, (backwards, up) in mm.
    outline = np.stack([-16.0 * np.sin(turn) * (1.0 + 0.18 * np.cos(turn)), 30.0 * np.cos(turn)], axis=1)
    lift = np.array([0.0, 0.0])
    rings = []
    for name, scale, out in (
        ("ear_back", 0.72, -7.0),
        ("ear_rim", 1.0, 1.0),
        ("ear_front", 0.9, 2.6),
        ("ear_valley", 0.68, -1.0),
    ):
        flat = outline * scale + lift
        rings.append(half.add(name, _beside_head(flat, np.full(8, out)), _SKIN))
    for outer, inner in zip(rings[:-1], rings[1:], strict=True):
        half.strip(outer, inner, closed=True)
    centre = half.add("ear_hollow", _beside_head(np.array([[3.0, -4.0]]), np.array([-5.0])), (190, 130, 110))
    half.fan(rings[-1], int(centre[0]))


def _beside_head(flat: Array, out: Array) -> Array:
    """Turn (backwards, up) and a distance outwards, in mm, into a place beside the head."""
    tilt, flare = np.deg2rad(-12.0), np.deg2rad(24.0)
    back = flat[:, 0] * np.cos(tilt) - flat[:, 1] * np.sin(tilt)
    up = flat[:, 0] * np.sin(tilt) + flat[:, 1] * np.cos(tilt)
    x = 79.5 + back * np.sin(flare) + out * np.cos(flare)
    z = -12.0 - back * np.cos(flare) + out * np.sin(flare)
    return np.stack([x, 14.0 + up, z], axis=1)
