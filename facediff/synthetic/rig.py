"""The puppet's muscles: smooth displacement fields and the contact of the lips.

A field is the displacement of every vertex of the neutral head at weight 1. For a speaker's head the displaced
neutral head is sent through the speaker's `Shape`, so that it moves in the speaker's own proportions. Poses add up
fields linearly, except where the lips meet: `Rig.pose` measures the gap between the lips that the other
fields leave and closes it by the share that ``lip_closure`` asks, and it never lets the lips cross.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from facediff.synthetic.face import EYE_CENTRE, LIP_COLUMNS, MOUTH_HALF_WIDTH, MOUTH_Y, build_face, contact_line
from facediff.synthetic.geometry import Array, HeadMesh, bump, rise

LINEAR_FIELDS = (
    "jaw_open",
    "lip_press",
    "pucker",
    "funnel",
    "stretch",
    "upper_lip_raise",
    "lower_lip_drop",
    "lower_lip_tuck",
    "corner_up",
    "corner_down",
    "cheek_raise",
    "cheek_puff",
    "chin_raise",
    "nose_wrinkle",
    "inner_brow_up",
    "outer_brow_up",
    "brow_frown",
    "lids_close",
    "lids_wide",
    "squint",
)
CONTROLS = (*LINEAR_FIELDS, "lip_closure")

_JAW_DEGREES = 9.8
_HINGE = (-4.0, 2.0)
_MOUTH_LOOPS = ("mouth_0", "lip_crest", "lip_front", "lip_inner", "lip_roll", "mouth_bag", "mouth_back")
_UPPER_SHARE = 0.35
# The lips may press into one another by half of this before contact stops them; too little to be seen.
_SOFT_CONTACT = 0.0004


@dataclass(frozen=True)
class Rig:
    """A speaker's head that can be posed."""

    neutral: Array  # Vertices at rest in metres, shape (V, 3)
    fields: Array  # Displacement at weight 1 in metres, shape (K, V, 3), in the order of `LINEAR_FIELDS`
    upper: NDArray[np.int64]  # Inner border of the upper lip from right to left, shape (C,)
    lower: NDArray[np.int64]  # Inner border of the lower lip, facing `upper`, shape (C,)
    # How far each vertex follows the closing of each column of the lips, shape (V, C); negative for the upper
    # lip, which comes down
    contact: Array

    def pose(self, weights: Array) -> Array:
        """Vertices (T, V, 3) in metres for one row of weights (T, K + 1) per frame, in the order of `CONTROLS`."""
        # Sums are written out: a BLAS may split them differently from run to run, and then bits differ.
        vertices = np.repeat(self.neutral[None], len(weights), axis=0)
        for column, field in enumerate(self.fields):
            vertices += weights[:, column, None, None] * field
        gap = vertices[:, self.upper, 1:] - vertices[:, self.lower, 1:]
        left = gap * (1.0 - np.clip(weights[:, -1], 0.0, 1.0))[:, None, None]
        height = left[..., 0]
        # A smooth ramp: follows an open gap, but a negative one (lips that cross) flattens out near zero.
        left[..., 0] = 0.5 * (height + np.sqrt(height**2 + _SOFT_CONTACT**2) - _SOFT_CONTACT)
        closing = gap - left
        for column, share in enumerate(self.contact.T):
            touched = np.flatnonzero(share)
            vertices[:, touched, 1:] += share[touched, None] * closing[:, column, None, :]
        return np.asarray(vertices)


def build_rig(shape: Shape, asymmetry: float = 0.0) -> Rig:
    """Build a speaker's rig; ``asymmetry`` is how much stronger the left side of the face moves, about -0.2 to 0.2."""
    mesh = build_face()
    canonical = 1000.0 * mesh.vertices
    side = 1.0 + asymmetry * np.tanh(canonical[:, 0] / 15.0)
    neutral = shape(mesh.vertices)
    moves = _fields(mesh, canonical)
    for name in LINEAR_FIELDS:
        if name not in ("jaw_open", "lids_close"):
            moves[name] *= side[:, None]
    posed = [shape((canonical + moves[name]) / 1000.0) - neutral for name in LINEAR_FIELDS]
    upper, lower = lip_pairs(mesh)
    return Rig(neutral, np.stack(posed), upper, lower, _contact(mesh, canonical, upper))


def lip_pairs(mesh: HeadMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Facing vertices of the lips' inner borders, (upper, lower), from right to left without the corners."""
    chain = mesh.groups["lip_inner"]
    top, bottom = chain[:7], chain[:7:-1]
    return np.concatenate([mesh.mirror[top[:0:-1]], top]), np.concatenate([mesh.mirror[bottom[:0:-1]], bottom])


def eyelid_pairs(mesh: HeadMesh) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Facing vertices of the lids' edges, (upper, lower), of both eyes without the corners."""
    ring = mesh.groups["eye_0"]  # from the inner corner over the upper lid to the outer one, and back below
    upper, lower = ring[1:8], ring[:8:-1]
    return np.concatenate([upper, mesh.mirror[upper]]), np.concatenate([lower, mesh.mirror[lower]])


def lip_side(mesh: HeadMesh, canonical: Array) -> Array:
    """How far each vertex belongs to the jaw's side of the mouth: 0 upper lip, 1 lower lip, shape (V,)."""
    x, y = np.abs(canonical[:, 0]), canonical[:, 1]
    soft = 2.0 + 22.0 * rise(x, 5.0, 42.0)
    below = rise(contact_line(x) - y, -soft, soft)
    # Near the corners both lips share the corner's way, so that an open mouth is round and not a box.
    corner = (LIP_COLUMNS[:7] / MOUTH_HALF_WIDTH) ** 3
    upper, lower = 0.42 * corner, 1.0 - 0.42 * corner
    chain = np.concatenate([upper, [0.47], lower[::-1]])
    for name in _MOUTH_LOOPS:
        index = mesh.groups[name]
        below[index] = chain
        below[mesh.mirror[index]] = chain
    return below


def soft_parts(mesh: HeadMesh, canonical: Array) -> tuple[Array, Array]:
    """How far each vertex is skin at the front of the face, and how far it follows inside the mouth; both (V,)."""
    skin = np.ones(len(canonical))
    rigid = ["pupil", *(n for n in mesh.groups if n.startswith(("eyeball", "teeth", "ear")))]
    skin[mesh.both(*rigid)] = 0.0
    skin *= rise(canonical[:, 2], -10.0, 35.0)
    inside = np.ones(len(canonical))
    for name, share in (("lip_roll", 0.9), ("mouth_bag", 0.45), ("mouth_back", 0.15)):
        inside[mesh.both(name)] = share
    return skin, inside


def _fields(mesh: HeadMesh, canonical: Array) -> dict[str, Array]:
    """Displacements of the neutral head in mm, each of shape (V, 3)."""
    x, y = np.abs(canonical[:, 0]), canonical[:, 1]
    sign = np.sign(canonical[:, 0])
    below = lip_side(mesh, canonical)
    skin, inside = soft_parts(mesh, canonical)

    def move(dx: Array | float = 0.0, dy: Array | float = 0.0, dz: Array | float = 0.0) -> Array:
        return np.stack(np.broadcast_arrays(sign * dx, dy, dz, np.zeros_like(x))[:3], axis=-1)

    def hill(centre: tuple[float, float], width: tuple[float, float]) -> Array:
        return skin * inside * bump(x, y, centre, width)

    off_line = y - contact_line(x)
    mouth = hill((0, -48), (21, 15))
    upper, lower = hill((0, -43), (14, 9)) * (1.0 - below), hill((0, -54), (14, 9)) * below
    corner = hill((26, -48), (10, 11))
    press = hill((0, -48), (18, 9))
    ball = hill((0, -50), (24, 10)) * below
    brow = rise(y, 30.0, 42.0)
    inner, outer = hill((12, 48), (10, 12)) * brow, hill((45, 46), (11, 13)) * brow
    lids, wide, squint = _lids(mesh, canonical)
    middle = rise(x, 0.0, 12.0)
    return {
        "jaw_open": _jaw(mesh, canonical, below),
        "lip_press": move(dy=-0.30 * off_line * press, dz=-1.8 * press),
        "pucker": move(-0.42 * x * mouth, 0.18 * off_line * mouth, 8.0 * mouth),
        "funnel": move(-0.22 * x * mouth, 3.6 * upper - 3.6 * lower, 4.5 * mouth),
        "stretch": move(6.0 * corner, -0.12 * off_line * mouth, -3.2 * corner - 1.2 * mouth),
        "upper_lip_raise": move(0.0, 4.5 * upper, 0.8 * upper),
        "lower_lip_drop": move(0.0, -4.8 * lower, 0.9 * lower),
        "lower_lip_tuck": move(0.0, 3.6 * ball, -6.0 * ball),
        "corner_up": move(3.5 * corner, 5.0 * corner + 1.2 * hill((38, -28), (13, 14)), -2.0 * corner),
        "corner_down": move(0.5 * corner, -5.0 * corner, -0.5 * corner),
        "cheek_raise": move(0.0, 3.6 * hill((38, -4), (14, 13)), 1.8 * hill((38, -6), (14, 12))),
        "cheek_puff": move(3.5 * hill((42, -46), (14, 15)), 0.0, 3.0 * hill((38, -46), (15, 15))),
        "chin_raise": move(0.0, 4.0 * hill((0, -74), (16, 12)) + 1.5 * lower, 1.5 * hill((0, -76), (14, 10))),
        "nose_wrinkle": move(0.5 * hill((15, -14), (7, 8)), 2.6 * hill((15, -12), (9, 13)), 0.0),
        "inner_brow_up": move(0.0, 6.0 * inner, 0.8 * inner),
        "outer_brow_up": move(0.0, 6.0 * outer, 0.5 * outer),
        "brow_frown": move(
            -3.2 * hill((18, 44), (9, 9)) * brow * middle,
            -4.2 * hill((16, 45), (12, 10)) * brow,
            1.0 * hill((12, 42), (8, 7)) * brow,
        ),
        "lids_close": lids,
        "lids_wide": wide,
        "squint": squint,
    }


def jaw_share(mesh: HeadMesh, canonical: Array, below: Array) -> Array:
    """How far each vertex follows the lower jaw, (V,)."""
    y, z = canonical[:, 1], canonical[:, 2]
    weight = below * rise(z, -12.0, 30.0) * rise(y, -128.0, -96.0) * rise(y, 8.0, -22.0)
    for name, share in (("mouth_back", 0.55), ("mouth_bag", 0.9)):
        weight[mesh.both(name)] *= share
    rigid = [name for name in mesh.groups if name.startswith(("eyeball", "ear", "teeth"))]
    weight[mesh.both("pupil", *rigid)] = 0.0
    weight[mesh.both(*(name for name in mesh.groups if name.startswith("teeth_lower")))] = 1.0
    return np.asarray(weight)


def _jaw(mesh: HeadMesh, canonical: Array, below: Array) -> Array:
    """Turn of the lower jaw about an axis through the ears."""
    y, z = canonical[:, 1], canonical[:, 2]
    weight = jaw_share(mesh, canonical, below)
    turn = np.deg2rad(_JAW_DEGREES)
    down, forward = y - _HINGE[0], z - _HINGE[1]
    dy = np.cos(turn) * down - np.sin(turn) * forward - down
    dz = np.sin(turn) * down + np.cos(turn) * forward - forward
    return np.stack([np.zeros_like(y), weight * dy, weight * dz], axis=-1)


def _lids(mesh: HeadMesh, canonical: Array) -> tuple[Array, Array, Array]:
    """Closing, widening and squinting: each upper lid vertex travels towards the lower one below it."""
    close, wide, squint = (np.zeros_like(canonical) for _ in range(3))
    follow = {"eye_0": 1.0, "lid_inner": 1.0, "eye_1": 0.62, "eye_2": 0.12}
    edge = canonical[mesh.groups["eye_0"]]
    top, bottom = edge[1:8], edge[9:][::-1]
    meet = bottom + np.array([0.0, 0.12, 0.0]) * (top - bottom)
    # On its way over the ball the straight path of the lid would cut into the eye: let it end further out.
    ahead = np.array([0.0, 0.0, 0.7])
    for name, share in follow.items():
        index = mesh.groups[name]
        down, up = np.zeros((16, 3)), np.zeros((16, 3))
        down[1:8] = meet - top + ahead
        up[9:] = (meet - bottom)[::-1] + ahead * 0.5
        span = np.sin(np.pi * np.linspace(0.06, 0.94, 7))[:, None]
        raised, lowered = np.zeros((16, 3)), np.zeros((16, 3))
        raised[1:8] = span * np.array([0.0, 1.8, -0.5])
        lowered[9:] = (span * np.array([0.0, 1.9, 0.5]))[::-1]
        for field, move in ((close, down + up), (wide, raised), (squint, lowered)):
            field[index] = share * move
            field[mesh.mirror[index]] = share * move * np.array([-1.0, 1.0, 1.0])
    return close, wide, squint


def _contact(mesh: HeadMesh, canonical: Array, upper: NDArray[np.int64]) -> Array:
    """How every vertex follows the columns of the lips when they close, shape (V, C)."""
    x, y = canonical[:, 0], canonical[:, 1]
    columns = canonical[upper, 0]
    # The corners hold still, so the outermost columns fade towards them.
    knots = np.concatenate([[-25.0], columns, [25.0]])
    hats = np.stack([np.interp(x, knots, row) for row in np.eye(len(knots))[1:-1]], axis=1)
    below = lip_side(mesh, canonical)
    near = bump(np.zeros_like(x), y, (0.0, -48.0), (1.0, 11.0)) * rise(canonical[:, 2], 40.0, 75.0)
    for name, nearness in zip(_MOUTH_LOOPS, (0.9, 1.0, 1.0, 1.0, 1.0, 0.5, 0.1), strict=True):
        near[mesh.both(name)] = nearness
    near[mesh.both(*(n for n in mesh.groups if n.startswith("teeth")))] = 0.0
    share = np.where(below < 0.5, -_UPPER_SHARE * (1 - 2 * below), (1 - _UPPER_SHARE) * (2 * below - 1))
    weight: Array = hats * (near * share)[:, None]
    for name in _MOUTH_LOOPS[1:5]:
        # Vertices of one column follow that column alone, wherever their x has gone on the way inwards.
        index = mesh.groups[name]
        weight[index] = weight[mesh.mirror[index]] = 0.0
        for column in range(7):
            for vertex, part in ((index[column], -_UPPER_SHARE), (index[14 - column], 1.0 - _UPPER_SHARE)):
                weight[vertex, 6 + column] = part
                weight[mesh.mirror[vertex], 6 - column] = part
    return weight


# Different speakers: smooth deformations of space that turn the neutral head into a speaker's.
#
# A `Shape` is a function of points, not a table of vertices. A pose of the neutral head can be sent through it as well
# as the neutral head itself, so that the rig moves in the speaker's own proportions.


@dataclass(frozen=True)
class Shape:
    """How a head differs from the neutral one; every number is about -1 to 1, and 0 changes nothing."""

    width: float = 0.0  # Whole head wider
    length: float = 0.0  # Lower face longer
    depth: float = 0.0  # Back of the head fuller
    jaw: float = 0.0  # Jaw wider at its angle
    chin_width: float = 0.0  # Chin broader and squarer
    chin: float = 0.0  # Chin longer and further forward
    neck: float = 0.0  # Neck thicker
    nose_length: float = 0.0  # Nose longer downwards
    nose_width: float = 0.0  # Nose broader at its wings
    nose_bridge: float = 0.0  # Bridge higher
    nose_tip: float = 0.0  # Tip further forward
    nose_up: float = 0.0  # Tip turned up
    eye_size: float = 0.0  # Eyes larger
    eye_gap: float = 0.0  # Eyes further apart
    eye_tilt: float = 0.0  # Outer corners higher
    brow_height: float = 0.0  # Brows higher
    brow_ridge: float = 0.0  # Ridge above the eyes stronger
    brow_tilt: float = 0.0  # Outer ends of the brows higher
    lips: float = 0.0  # Lips fuller
    mouth_width: float = 0.0  # Mouth wider
    mouth_forward: float = 0.0  # Mouth further forward
    cheekbones: float = 0.0  # Cheekbones stronger
    cheeks: float = 0.0  # Cheeks fuller
    forehead: float = 0.0  # Forehead higher and rounder
    ears: float = 0.0  # Ears larger and further from the head

    def __call__(self, points: Array) -> Array:
        """Where points (..., 3) of the neutral head lie in this speaker's head, both in metres."""
        x, y, z = (1000.0 * points[..., axis] for axis in range(3))
        moves = _moves(np.abs(x), y, z)
        moved = np.asarray(sum(getattr(self, f.name) * moves[f.name] for f in fields(self)))
        side = np.stack([np.sign(x), np.ones_like(x), np.ones_like(x)], axis=-1)
        return np.asarray(points + moved * side / 1000.0)


def _moves(x: Array, y: Array, z: Array) -> dict[str, Array]:
    """Displacement in mm of every point of the left half for each number of `Shape` at 1."""
    front = rise(z, 0.0, 50.0)
    zero = np.zeros_like(x)

    def move(dx: Array = zero, dy: Array = zero, dz: Array = zero) -> Array:
        return np.stack(np.broadcast_arrays(dx, dy, dz), axis=-1)

    below_nose = rise(y, -5.0, -90.0) * rise(y, -150.0, -105.0)
    mouth = bump(x, y, (0, MOUTH_Y), (24, 13)) * front
    tip = bump(x, y, (0, -12), (9, 9)) * rise(z, 75.0, 105.0)
    nose = bump(x, y, (0, -12), (16, 15)) * front
    eye_x, eye_y = x - EYE_CENTRE[0], y - EYE_CENTRE[1]
    eye = bump(x, y, EYE_CENTRE[:2], (17, 13)) * front
    brow = bump(x, y, (30, 44), (22, 9)) * front
    chin = bump(x, y, (0, -84), (20, 17)) * front
    ear = rise(x, 68.0, 82.0) * bump(y, z, (14, -16), (30, 24))
    return {
        "width": move(0.068 * x * rise(y, -150.0, -60.0)),
        "length": move(dy=-11.0 * below_nose),
        "depth": move(dz=0.07 * np.minimum(z + 5.0, 0.0)),
        "jaw": move(8.0 * bump(y, z, (-58, 15), (24, 34)) * rise(x, 8.0, 50.0)),
        "chin_width": move(5.0 * bump(y, z, (-84, 75), (14, 25)) * rise(x, 0.0, 20.0) * rise(x, 75.0, 30.0)),
        "chin": move(dy=-6.0 * chin, dz=5.0 * chin),
        "neck": move(0.14 * x * rise(y, -75.0, -115.0), dz=0.10 * (z + 20.0) * rise(y, -88.0, -118.0)),
        "nose_length": move(dy=-5.5 * nose),
        "nose_width": move(0.36 * x * bump(x, y, (0, -16), (15, 10)) * front),
        "nose_bridge": move(dz=5.0 * bump(x, y, (0, 18), (6, 14)) * front),
        "nose_tip": move(dz=4.0 * tip),
        "nose_up": move(dy=3.0 * tip, dz=-0.5 * tip),
        "eye_size": move(0.16 * eye_x * eye, 0.26 * eye_y * eye, 0.10 * (z - EYE_CENTRE[2]) * eye),
        "eye_gap": move(4.0 * bump(x, y, (32, 30), (20, 18)) * front * rise(x, 4.0, 20.0)),
        "eye_tilt": move(dy=0.17 * eye_x * eye),
        "brow_height": move(dy=4.2 * brow),
        "brow_ridge": move(dy=-1.0 * brow, dz=4.0 * bump(x, y, (24, 42), (20, 6)) * front),
        "brow_tilt": move(dy=0.18 * (x - 28.0) * brow),
        "lips": move(dy=0.38 * (y - MOUTH_Y) * mouth, dz=1.6 * bump(x, y, (0, MOUTH_Y), (15, 9)) * front),
        "mouth_width": move(0.2 * x * mouth),
        "mouth_forward": move(dz=3.5 * bump(x, y, (0, MOUTH_Y), (26, 20)) * front),
        "cheekbones": move(
            4.0 * bump(y, z, (-4, 50), (13, 22)) * rise(x, 20.0, 55.0),
            dz=3.5 * bump(x, y, (46, -3), (13, 12)) * front,
        ),
        "cheeks": move(
            6.0 * bump(y, z, (-34, 48), (20, 24)) * rise(x, 20.0, 55.0),
            dz=4.0 * bump(x, y, (42, -34), (15, 18)) * front,
        ),
        "forehead": move(dy=0.07 * np.maximum(y - 50.0, 0.0), dz=5.0 * bump(x, y, (0, 78), (45, 22)) * front),
        "ears": move(4.0 * ear, 0.12 * (y - 14.0) * ear, -2.0 * ear),
    }
