"""The rig of the head: ARKit's 52 shapes by name, and two of the tongue.

Every shape is a table of displacements, so that a pose is the neutral head plus a weighted sum of them, and weights and
vertices are two ways to write one motion. Lengths are in mm.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from facediff.spaces.arkit import ALPHABETICAL
from facediff.synthetic.geometry import Array, bump, rise
from facediff.synthetic.head.layout import EYE_POINTS, MOUTH_HALF_WIDTH, MOUTH_POINTS, MOUTH_Y, contact_line
from facediff.synthetic.head.mesh import QuadMesh
from facediff.synthetic.head.parts import (
    AROUND_MOUTH,
    EYE_CENTRE,
    EYE_RADIUS,
    LIP_LOOPS,
    build_head,
    lash_places,
)

TONGUE = ("tongueUp", "tongueForward")
"""Shapes that ARKit lacks and speech needs: the tip at the ridge behind the teeth (t, n, l), and between them (th)."""
SHAPES = (*ALPHABETICAL, *TONGUE)

JAW_DEGREES = 21.0  # Turn of the lower jaw at weight 1
HINGE = (0.0, 14.0)  # Height and depth of its axis, in front of the ears
LOOK_SIDEWAYS, LOOK_UP, LOOK_DOWN = 30.0, 25.0, 30.0  # Degrees by which an eyeball turns at weight 1
UPPER_SHARE = 0.3
"""Part of the way to meeting lips that the upper one goes (0.2 to 0.4 in people, Löfqvist and Gracco, 1997)."""
_MEET = 0.16
"""Where on the way from the lower to the upper edge closing lids meet."""
_MIRRORED = np.array([-1.0, 1.0, 1.0])


@lru_cache(maxsize=1)
def head_shapes() -> Mapping[str, Array]:
    """Displacements in mm (V, 3) of the average head for each of :data:`SHAPES` at weight 1."""
    return _Fields(build_head()).shapes()


def lip_pairs(mesh: QuadMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Vertices of the lips that touch, (upper, lower), from right to left without the corners."""
    loop, half = mesh.groups["lip_inner"], MOUTH_POINTS // 2
    upper, lower = loop[:half], loop[:half:-1]
    return np.concatenate([mesh.mirror[upper[:0:-1]], upper]), np.concatenate([mesh.mirror[lower[:0:-1]], lower])


def lip_teeth_pairs(mesh: QuadMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The middle of the lower lip and that of the upper incisors' edge, which it touches for f and v."""
    return mesh.groups["lip_inner"][-1:], mesh.groups["teeth_upper_edge"][:1]


def eyelid_pairs(mesh: QuadMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Facing vertices of the lids' edges, (upper, lower), of both eyes without the corners."""
    loop, half = mesh.groups["eye_edge"], EYE_POINTS // 2
    upper, lower = loop[1:half], loop[:half:-1]
    return np.concatenate([upper, mesh.mirror[upper]]), np.concatenate([lower, mesh.mirror[lower]])


class _Fields:
    """The shapes of one mesh, and the weights that say which part of it each of them moves."""

    def __init__(self, mesh: QuadMesh) -> None:
        self.mesh = mesh
        self.x, self.y, self.z = np.abs(mesh.vertices[:, 0]), mesh.vertices[:, 1], mesh.vertices[:, 2]
        self.sign = np.sign(mesh.vertices[:, 0])
        # Skin of the front of the face, which stretches; eyeballs, teeth and tongue do not, ears and hair stand still.
        self.soft = rise(self.z, -5.0, 35.0)
        self.soft[mesh.both("ball_", "iris_", "pupil", "glint", "teeth_", "tongue_", "hair", "ear_")] = 0.0
        for name, share in (("mouth_front", 0.8), ("mouth_bag", 0.35), ("mouth_back", 0.1)):
            self.soft[mesh.both(name)] *= share
        self.off_line = self.y - contact_line(np.minimum(self.x, MOUTH_HALF_WIDTH))
        self.lower = self._lower_lip()
        self.jaw = self._jaw_share()

    def shapes(self) -> dict[str, Array]:
        """All shapes by name."""
        symmetric = {**self._lids(), **self._mouth_sides(), **self._upper_face()}
        shapes = {**self._jaw(), **self._mouth(), **self._tongue()}
        shapes["mouthClose"] = self._closing(shapes["jawOpen"])
        shapes["browInnerUp"], shapes["cheekPuff"] = symmetric.pop("browInnerUp"), symmetric.pop("cheekPuff")
        # A side's share goes from 0 to 1 across the middle, so that two equal weights give the symmetric shape.
        left = rise(self.mesh.vertices[:, 0], -10.0, 10.0)[:, None]
        for name, field in symmetric.items():
            shapes[f"{name}Left"], shapes[f"{name}Right"] = left * field, (1.0 - left) * field
        return {name: shapes[name] for name in SHAPES}

    def _move(self, dx: Array | float = 0.0, dy: Array | float = 0.0, dz: Array | float = 0.0) -> Array:
        """Displacements; ``dx`` points away from the midline on both sides."""
        return np.stack(np.broadcast_arrays(self.sign * dx, dy, dz, np.zeros_like(self.x))[:3], axis=-1)

    def _hill(self, centre: tuple[float, float], width: tuple[float, float]) -> Array:
        """How far each vertex belongs to a place of the face, seen from the front."""
        return self.soft * bump(self.x, self.y, centre, width)

    def _loop(self, values: Array, name: str, on_loop: Array) -> None:
        """Set values (V,) or (V, 3) on a group of the left half and on its mirror image."""
        index = self.mesh.groups[name]
        values[index] = on_loop
        values[self.mesh.mirror[index]] = on_loop * _MIRRORED if values.ndim == 2 else on_loop

    def _lower_lip(self) -> Array:
        """How far each vertex belongs to the lower lip: 0 the upper one, 1 the lower one, (V,)."""
        soft = 1.5 + 20.0 * rise(self.x, 6.0, 44.0)
        lower = rise(-self.off_line, -soft, soft)
        # Both lips share the corner's way, so that an open mouth is round and has no edge there.
        position = np.arange(MOUTH_POINTS)
        corner = 0.4 * (np.minimum(position, MOUTH_POINTS - 1 - position) / (MOUTH_POINTS // 2)) ** 3.2
        half = MOUTH_POINTS // 2
        chain = np.where(position < half, corner, np.where(position > half, 1.0 - corner, 0.46))
        for name in (*AROUND_MOUTH, *LIP_LOOPS):
            share = {"mouth_far": 0.35, "mouth_near": 0.7}.get(name, 1.0)
            self._loop(lower, name, (1.0 - share) * lower[self.mesh.groups[name]] + share * chain)
        return lower

    def _jaw_share(self) -> Array:
        """How far each vertex follows the lower jaw, (V,)."""
        mesh = self.mesh
        share = self.lower * rise(self.z, -14.0, 26.0) * rise(self.y, -150.0, -104.0) * rise(self.y, 6.0, -20.0)
        share[mesh.both("mouth_bag")] *= 0.85
        share[mesh.both("mouth_back")] *= 0.5
        share[mesh.both("ball_", "iris_", "pupil", "glint", "teeth_upper", "hair", "ear_", "lash_", "brow_")] = 0.0
        share[mesh.both("teeth_lower")] = 1.0
        for number, root in enumerate(np.interp(np.arange(9), [0, 5, 8], [0.88, 0.75, 0.45])):
            share[mesh.both(f"tongue_{number}")] = root
        return share

    def _jaw(self) -> dict[str, Array]:
        turn = np.deg2rad(JAW_DEGREES)
        up, ahead = self.y - HINGE[0], self.z - HINGE[1]
        down = np.cos(turn) * up - np.sin(turn) * ahead - up
        back = np.sin(turn) * up + np.cos(turn) * ahead - ahead
        # An open mouth is narrower: the corners are drawn in by the cheeks.
        narrow = -0.07 * self.x * self._hill((0, MOUTH_Y), (22, 15)) * rise(self.x, 5.0, 25.0)
        aside = np.zeros((len(self.x), 3))
        aside[:, 0] = 6.0 * self.jaw
        return {
            "jawOpen": self._move(narrow, self.jaw * down, self.jaw * back),
            "jawForward": self._move(dz=6.0 * self.jaw),
            "jawLeft": aside,
            "jawRight": -aside,
        }

    def _mouth(self) -> dict[str, Array]:
        mouth, drawn = self._hill((0, MOUTH_Y), (22, 15)), self._hill((0, MOUTH_Y), (34, 18))
        upper = self._hill((0, -40), (15, 9)) * (1.0 - self.lower)
        lower = self._hill((0, -53), (15, 9)) * self.lower
        ball, top = self._hill((0, -50), (24, 9)) * self.lower, self._hill((0, -42), (24, 8)) * (1.0 - self.lower)
        aside = np.zeros((len(self.x), 3))
        aside[:, 0] = 7.0 * self._hill((0, MOUTH_Y), (26, 15))
        return {
            "mouthFunnel": self._move(
                -0.20 * self.x * mouth, 4.2 * upper - 4.4 * lower, 5.0 * mouth + 2.0 * (upper + lower)
            ),
            "mouthPucker": self._move(-0.40 * self.x * drawn, 0.20 * self.off_line * mouth, 8.5 * mouth),
            "mouthLeft": aside,
            "mouthRight": -aside,
            "mouthRollLower": self._move(0.0, 1.2 * ball, -6.5 * ball),
            "mouthRollUpper": self._move(0.0, -3.2 * top, -5.5 * top),
            "mouthShrugLower": self._move(
                0.0, 4.5 * self._hill((0, -74), (16, 12)) + 2.0 * lower, 1.5 * self._hill((0, -76), (14, 10)) + lower
            ),
            "mouthShrugUpper": self._move(0.0, 3.0 * upper, 2.0 * upper),
        }

    def _mouth_sides(self) -> dict[str, Array]:
        corner = self._hill((26, MOUTH_Y), (10, 11))
        wide = self._hill((29, MOUTH_Y), (13, 13)) * rise(self.x, 0.0, 16.0)
        press = self._hill((12, MOUTH_Y), (14, 8))
        mouth = self._hill((0, MOUTH_Y), (22, 15))
        upper = self._hill((9, -39), (10, 10)) * (1.0 - self.lower)
        lower = self._hill((9, -53), (10, 10)) * self.lower
        cheek = self._hill((38, -12), (14, 12))
        return {
            "mouthSmile": self._move(
                5.5 * wide,
                6.0 * wide + 2.0 * self._hill((36, -26), (13, 14)) + 2.0 * cheek,
                3.0 * cheek - 4.0 * corner - 1.5 * mouth,
            ),
            "mouthFrown": self._move(0.8 * corner, -6.0 * corner, -0.5 * corner),
            "mouthDimple": self._move(2.5 * corner, corner, -4.0 * corner),
            "mouthStretch": self._move(7.0 * corner, -1.5 * corner, -3.5 * corner - mouth),
            "mouthPress": self._move(0.0, -0.28 * self.off_line * press, -1.8 * press),
            "mouthUpperUp": self._move(0.3 * upper, 5.5 * upper + 1.5 * self._hill((14, -20), (9, 10)), 1.2 * upper),
            "mouthLowerDown": self._move(0.5 * lower, -5.5 * lower, 0.8 * lower),
        }

    def _upper_face(self) -> dict[str, Array]:
        # Brows rise on the forehead; the lids below them do not follow.
        above, high = rise(self.y, 27.0, 38.0), rise(self.y, 29.0, 41.0)
        return {
            "browInnerUp": self._move(
                0.0, 7.0 * high * self._hill((11, 46), (11, 13)), 0.8 * self._hill((11, 46), (10, 12))
            ),
            "browOuterUp": self._move(
                0.0, 6.5 * high * self._hill((42, 45), (12, 14)), 0.4 * self._hill((42, 45), (12, 14))
            ),
            "browDown": self._move(
                -2.6 * self._hill((20, 43), (10, 9)) * rise(self.x, 0.0, 10.0),
                -5.0 * self._hill((22, 43), (15, 9)) * above,
                1.2 * self._hill((14, 40), (9, 7)),
            ),
            "cheekPuff": self._move(6.0 * self._hill((40, -42), (14, 14)), 0.0, 5.0 * self._hill((34, -42), (14, 13))),
            "cheekSquint": self._move(0.0, 4.0 * self._hill((37, -2), (14, 13)), 2.2 * self._hill((37, -6), (14, 12))),
            "noseSneer": self._move(
                0.6 * self._hill((14, -14), (7, 8)),
                4.0 * self._hill((13, -13), (9, 12)),
                0.6 * self._hill((12, -8), (8, 10)),
            ),
        }

    def _lids(self) -> dict[str, Array]:
        """Blink, wide and squint: edges of the lids slide over the eyeball, the skin round them follows less and less.

        The eyes' turns are here too: the upper lid covers the iris' upper rim wherever it looks.
        """
        blink, wide, squint = (np.zeros((len(self.x), 3)) for _ in range(3))
        half = EYE_POINTS // 2
        edge = self.mesh.vertices[self.mesh.groups["eye_edge"]]
        top, bottom = edge[: half + 1], np.concatenate([edge[:1], edge[: half - 1 : -1]])
        # The straight way from open to shut would cut into the ball: it ends further out than it begins.
        meet = _outside_ball(bottom + _MEET * (top - bottom), EYE_RADIUS + 1.0)
        along = np.linspace(0.0, 1.0, half + 1)
        arch = np.sin(np.pi * along)[:, None]
        closing = _round_the_eye(meet - top, meet - bottom)
        raised = _round_the_eye(arch * [0.0, 2.0, -0.5], np.zeros_like(top))
        squeezed = _round_the_eye(arch * [0.0, -0.48, 0.12], arch * [0.0, 2.2, 0.4])
        side = np.concatenate([[0.0], np.ones(half - 1), [0.0], -np.ones(half - 1)])[:, None]
        taper = np.minimum(1.0, 2.0 * np.concatenate([arch, arch[-2:0:-1]]))
        for name, share in (
            ("eye_far", 0.30),
            ("eye_crease", 0.68),
            ("eye_near", 0.92),
            ("eye_edge", 1.0),
            ("lid_edge", 1.0),
            ("lid_behind", 1.0),
            ("lid_end", 0.9),
        ):
            points = self.mesh.vertices[self.mesh.groups[name]]
            # Skin that follows the lid must not sink into the ball, nor overtake the edge next to the corners.
            follow = share * closing * (1.0 - (1.0 - taper) * (0.6 if share < 1.0 else 0.0))
            over_ball = _outside_ball(points + follow, EYE_RADIUS + 1.6 - share) - points
            self._loop(blink, name, np.where(side == 0.0, follow, over_ball))
            self._loop(wide, name, share * raised)
            self._loop(squint, name, share * squeezed)
        # Behind their edges shut lids lie on the ball, each on its own side of the line where they meet.
        for name, beyond in (("lid_edge", 0.15), ("lid_behind", 1.6), ("lid_end", 4.0)):
            points = self.mesh.vertices[self.mesh.groups[name]]
            away = edge + closing + side * taper * beyond * np.array([0.0, 1.0, 0.0]) - EYE_CENTRE
            on_ball = EYE_CENTRE + away * (EYE_RADIUS + 0.4) / np.linalg.norm(away, axis=1, keepdims=True)
            self._loop(blink, name, np.where(side == 0.0, closing, on_ball - points))
        for number, position in enumerate(lash_places()):
            root = np.array([np.interp(position, along, (meet - top)[:, axis]) for axis in range(3)])
            # The tip swings down, since the lid turns with the ball.
            self._loop(blink, f"lash_{number:02d}", root + np.array([[0, 0, 0], [0, 0, 0], [0.0, -5.0, 1.0]]))
            self._loop(
                wide, f"lash_{number:02d}", np.tile(np.sin(np.pi * position) * np.array([0.0, 2.0, -0.5]), (3, 1))
            )
        bag = self._hill((33, 8), (14, 9))
        looks = {
            "eyeLookIn": self._look(-LOOK_SIDEWAYS, 0.0),
            "eyeLookOut": self._look(LOOK_SIDEWAYS, 0.0),
            "eyeLookUp": self._look(0.0, LOOK_UP) + 0.9 * wide,
            "eyeLookDown": self._look(0.0, -LOOK_DOWN) + 0.45 * blink,
        }
        squint = squint + self._move(0.0, 2.2 * bag, bag)
        return {"eyeBlink": blink, "eyeWide": wide, "eyeSquint": squint, **looks}

    def _look(self, outwards: float, up: float) -> Array:
        """Both eyeballs turned by degrees about their centres, away from the midline and up."""
        about, lift = np.deg2rad(outwards), np.deg2rad(-up)
        sideways = np.array([[np.cos(about), 0, np.sin(about)], [0, 1, 0], [-np.sin(about), 0, np.cos(about)]])
        upwards = np.array([[1, 0, 0], [0, np.cos(lift), -np.sin(lift)], [0, np.sin(lift), np.cos(lift)]])
        moves = np.zeros((len(self.x), 3))
        for name in self.mesh.groups:
            if name.startswith(("ball_", "iris_", "pupil", "glint")):
                points = self.mesh.vertices[self.mesh.groups[name]] - EYE_CENTRE
                share = 0.5 if name == "glint" else 1.0  # a reflection goes half as far as the mirror turns
                self._loop(moves, name, share * (points @ (sideways @ upwards).T - points))
        return moves

    def _closing(self, opened: Array) -> Array:
        """The shape that makes the lips meet when it is added to ``jawOpen`` at the same weight."""
        mesh = self.mesh
        half = MOUTH_POINTS // 2
        loop = mesh.groups["lip_inner"]
        gap = opened[loop[:half]] - opened[loop[:half:-1]]  # of each column, (10, 3), from the midline outwards
        columns = np.append(mesh.vertices[loop[:half], 0], MOUTH_HALF_WIDTH)
        gap = np.concatenate([gap, np.zeros((1, 3))])
        way = np.stack([np.interp(self.x, columns, gap[:, axis]) for axis in range(3)], axis=1)
        near = bump(0.0, self.y, (0.0, MOUTH_Y), (1.0, 11.0)) * rise(self.z, 40.0, 75.0) * (self.soft > 0)
        share = np.where(
            self.lower < 0.5, -UPPER_SHARE * (1 - 2 * self.lower), (1 - UPPER_SHARE) * (2 * self.lower - 1)
        )
        for name, nearness in (("mouth_front", 0.8), ("mouth_bag", 0.2), ("mouth_back", 0.0)):
            near[mesh.both(name)] = nearness
        moves = (near * share)[:, None] * way * np.array([0.0, 1.0, 1.0])
        # On the lips each vertex goes with its column, and the two sides together close the gap completely.
        position = np.arange(MOUTH_POINTS)
        column = np.minimum(position, MOUTH_POINTS - 1 - position)
        part = np.where(position < half, -UPPER_SHARE, np.where(position > half, 1.0 - UPPER_SHARE, 0.0))
        for name in ("lip_border", *LIP_LOOPS[:5]):
            fade = 0.85 if name == "lip_border" else 1.0
            self._loop(moves, name, fade * part[:, None] * gap[column])
        return moves

    def _tongue(self) -> dict[str, Array]:
        out, up, forward = (np.zeros((len(self.x), 3)) for _ in range(3))
        for number in range(9):
            index = self.mesh.both(f"tongue_{number}")
            tip = 1.0 - number / 8.0
            out[index] = np.array([0.0, -2.0 * tip**2, 26.0 * tip])
            up[index] = np.array([0.0, 9.0 * rise(tip, 0.3, 1.0), 2.0 * tip])
            forward[index] = np.array([0.0, 3.5 * tip, 9.0 * tip])
        return {"tongueOut": out, "tongueUp": up, "tongueForward": forward}


def _outside_ball(points: Array, radius: float) -> Array:
    """Points moved away from the eye's centre to at least a distance."""
    away = points - EYE_CENTRE
    return EYE_CENTRE + away * np.maximum(1.0, radius / np.linalg.norm(away, axis=1, keepdims=True))


def _round_the_eye(upper: Array, lower: Array) -> Array:
    """Moves of a loop round the eye (24, 3) from its upper and its lower half, both (13, 3) with corners."""
    return np.concatenate([upper, lower[-2:0:-1]])
