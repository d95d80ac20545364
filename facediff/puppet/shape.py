"""Different people: smooth deformations of space that turn the neutral head into a speaker's.

A `Shape` is a function of points, not a table of vertices. A pose of the neutral head can be sent through
it as well as the neutral head itself, and that is how the rig comes to act in the speaker's own proportions.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from facediff.puppet.curves import Array, bump, rise
from facediff.puppet.surface import EYE_CENTRE, MOUTH_Y


@dataclass(frozen=True)
class Shape:
    """How a head differs from the neutral one; every number is about -1 to 1, and 0 changes nothing.

    Attributes:
        width: Whole head wider.
        length: Lower face longer.
        depth: Back of the head fuller.
        jaw: Jaw wider at its angle.
        chin_width: Chin broader and squarer.
        chin: Chin longer and further forward.
        neck: Neck thicker.
        nose_length: Nose longer downwards.
        nose_width: Nose broader at its wings.
        nose_bridge: Bridge higher.
        nose_tip: Tip further forward.
        nose_up: Tip turned up.
        eye_size: Eyes larger.
        eye_gap: Eyes further apart.
        eye_tilt: Outer corners higher.
        brow_height: Brows higher.
        brow_ridge: Ridge above the eyes stronger.
        brow_tilt: Outer ends of the brows higher.
        lips: Lips fuller.
        mouth_width: Mouth wider.
        mouth_forward: Mouth further forward.
        cheekbones: Cheekbones stronger.
        cheeks: Cheeks fuller.
        forehead: Forehead higher and rounder.
        ears: Ears larger and further from the head.
    """

    width: float = 0.0
    length: float = 0.0
    depth: float = 0.0
    jaw: float = 0.0
    chin_width: float = 0.0
    chin: float = 0.0
    neck: float = 0.0
    nose_length: float = 0.0
    nose_width: float = 0.0
    nose_bridge: float = 0.0
    nose_tip: float = 0.0
    nose_up: float = 0.0
    eye_size: float = 0.0
    eye_gap: float = 0.0
    eye_tilt: float = 0.0
    brow_height: float = 0.0
    brow_ridge: float = 0.0
    brow_tilt: float = 0.0
    lips: float = 0.0
    mouth_width: float = 0.0
    mouth_forward: float = 0.0
    cheekbones: float = 0.0
    cheeks: float = 0.0
    forehead: float = 0.0
    ears: float = 0.0

    def __call__(self, points: Array) -> Array:
        """Deform points of the neutral head.

        Args:
            points: Positions in metres, shape (..., 3).

        Returns:
            Where they lie in this speaker's head, in metres, the same shape.
        """
        x, y, z = (1000.0 * points[..., axis] for axis in range(3))
        moves = _moves(np.abs(x), y, z)
        total = sum(getattr(self, f.name) * moves[f.name] for f in fields(self))
        moved = np.asarray(total)
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
