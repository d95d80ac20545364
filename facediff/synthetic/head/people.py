"""People who differ: smooth deformations of space that turn the average head into a person's, and their colours.

A :class:`Face` is a function of points and not a table of vertices, so that a pose of the average head can be sent
through it as well as the head at rest, and the rig moves in the person's own proportions.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from facediff.synthetic.geometry import Array, bump, rise
from facediff.synthetic.head.hair import HAIR_COLUMNS, HAIR_ROWS, HairStyle, density, hair_points
from facediff.synthetic.head.layout import MOUTH_Y
from facediff.synthetic.head.mesh import QuadMesh
from facediff.synthetic.head.parts import BROW_COLUMNS, EYE_CENTRE, HAIR, SHIRT, SKIN

SKIN_TONES = {
    "pale": (238, 200, 180),
    "fair": (226, 178, 154),
    "olive": (206, 158, 122),
    "tan": (178, 124, 90),
    "brown": (136, 90, 64),
    "dark": (92, 60, 46),
}
HAIR_COLOURS = {
    "black": (34, 28, 26),
    "brown": HAIR,
    "auburn": (112, 58, 36),
    "blond": (186, 148, 92),
    "grey": (150, 148, 146),
    "white": (222, 220, 216),
}
SHIRTS = {
    "slate": SHIRT,
    "navy": (48, 58, 88),
    "teal": (52, 110, 112),
    "rust": (162, 88, 62),
    "sand": (190, 172, 142),
    "wine": (110, 46, 58),
    "moss": (96, 110, 74),
}
STRANDS, MOTTLED = 0.14, 0.008
"""Spread of the brightness of strands, and of the colour of places of skin."""
LID_SHADOW = 0.55
"""Share of the light that is left below the upper lid."""
EYE_COLOURS = {"blue": (96, 128, 150), "grey": (120, 130, 132), "green": (98, 122, 84), "brown": (98, 66, 42)}


@dataclass(frozen=True)
class Complexion:
    """The colours of a person, how the hair is worn, and the shirt."""

    skin: str = "fair"  # A name in SKIN_TONES
    hair: str = "brown"  # A name in HAIR_COLOURS
    eyes: str = "grey"  # A name in EYE_COLOURS
    style: HairStyle = "short"
    shirt: str = "slate"  # A name in SHIRTS
    stubble: float = 0.0  # How dense the shadow of a beard is, 0 to 1


@dataclass(frozen=True)
class Face:
    """The differences of a head from the average one, by groups of people and of the person alone.

    Every number is about -1 to 1, and 0 changes nothing.
    """

    sex: float = 0.0  # -1 as women's faces are on average, 1 as men's
    age: float = 0.0  # Older: fuller lower face, thinner lips, longer nose and ears, deeper folds
    weight: float = 0.0  # Fuller cheeks, neck and chin
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
        """Where points (..., 3) of the average head lie in this person's, both in mm."""
        moves = _moves(np.abs(points[..., 0]), points[..., 1], points[..., 2])
        moved = np.sum([weight * moves[name] for name, weight in self.details().items()], axis=0)
        side = np.sign(points[..., 0])
        return np.asarray(points + moved * np.stack([side, np.ones_like(side), np.ones_like(side)], axis=-1))

    def details(self) -> dict[str, float]:
        """The numbers after the first three, with what these add to them."""
        details = {item.name: float(getattr(self, item.name)) for item in fields(self)}
        groups = {name: details.pop(name) for name in _GROUPS}
        for group, shares in _GROUPS.items():
            for name, share in shares.items():
                details[name] += groups[group] * share
        return details


# Directions of the differences after Farkas' tables (1994) for sex and after Farkas and others (J. Craniofac. Surg. 15,
# 2004) for age: men's faces are longer and broader with a stronger jaw, brow ridge and nose and thinner lips; with age
# the nose and the ears grow, the lips thin and the lower face fills.
_GROUPS: dict[str, dict[str, float]] = {
    "sex": {
        **{"width": 0.35, "length": 0.4, "jaw": 0.7, "chin_width": 0.6, "chin": 0.4, "neck": 0.8, "nose_width": 0.35},
        **{"nose_bridge": 0.4, "brow_ridge": 0.8, "brow_height": -0.5, "lips": -0.4, "eye_size": -0.3, "cheeks": -0.3},
        **{"forehead": -0.4, "ears": 0.3},
    },
    "age": {
        **{"nose_length": 0.5, "nose_up": -0.5, "lips": -0.6, "ears": 0.5, "cheeks": 0.2, "jaw": 0.2, "eye_size": -0.3},
        **{"brow_height": -0.4, "eye_tilt": -0.3},
    },
    "weight": {"cheeks": 1.0, "neck": 0.8, "jaw": 0.5, "width": 0.3, "chin_width": 0.4, "cheekbones": -0.3},
}


def _moves(x: Array, y: Array, z: Array) -> dict[str, Array]:
    """Displacement in mm of every point of the left half for each detail at 1."""
    front = rise(z, 0.0, 50.0)
    zero = np.zeros_like(x)

    def move(dx: Array = zero, dy: Array = zero, dz: Array = zero) -> Array:
        return np.stack(np.broadcast_arrays(dx, dy, dz), axis=-1)

    below_nose = rise(y, -8.0, -92.0) * rise(y, -152.0, -107.0)
    mouth = bump(x, y, (0, MOUTH_Y), (26, 14)) * front
    tip = bump(x, y, (0, -13), (9, 9)) * rise(z, 78.0, 106.0)
    nose = bump(x, y, (0, -12), (16, 15)) * front
    # The eyeball must stay a ball: within its reach every move is one translation or one scale about its centre.
    eye_x, eye_y, eye_z = x - EYE_CENTRE[0], y - EYE_CENTRE[1], z - EYE_CENTRE[2]
    reach = np.sqrt(eye_x**2 + eye_y**2 + (0.7 * eye_z) ** 2)
    eye = rise(reach, 34.0, 14.0)
    brow = bump(x, y, (30, 44), (22, 9)) * front * rise(reach, 14.0, 20.0)
    chin = bump(x, y, (0, -84), (20, 17)) * front
    ear = rise(x, 66.0, 80.0) * bump(y, z, (6, -14), (30, 24))
    return {
        "width": move(0.06 * x * rise(y, -152.0, -60.0) * (1 - eye) + eye * 0.06 * EYE_CENTRE[0]),
        "length": move(dy=-10.0 * below_nose),
        "depth": move(dz=0.07 * np.minimum(z + 5.0, 0.0)),
        "jaw": move(7.0 * bump(y, z, (-52, 14), (22, 34)) * rise(x, 8.0, 50.0)),
        "chin_width": move(5.0 * bump(y, z, (-86, 74), (14, 25)) * rise(x, 0.0, 20.0) * rise(x, 75.0, 30.0)),
        "chin": move(dy=-5.0 * chin, dz=5.0 * chin),
        "neck": move(0.13 * x * rise(y, -72.0, -112.0), dz=0.10 * (z + 20.0) * rise(y, -90.0, -120.0)),
        "nose_length": move(dy=-4.5 * nose),
        "nose_width": move(0.30 * x * bump(x, y, (0, -18), (15, 10)) * front),
        "nose_bridge": move(dz=4.0 * bump(x, y, (0, 16), (6, 14)) * front),
        "nose_tip": move(dz=4.0 * tip),
        "nose_up": move(dy=3.0 * tip, dz=-0.5 * tip),
        "eye_size": move(0.10 * eye_x * eye, 0.10 * eye_y * eye, 0.10 * eye_z * eye),
        "eye_gap": move(3.0 * rise(reach, 40.0, 14.0)),
        "eye_tilt": move(dy=0.14 * eye_x * eye * rise(reach, 12.4, 15.0)),
        "brow_height": move(dy=3.6 * brow),
        "brow_ridge": move(dy=-0.8 * brow, dz=3.0 * bump(x, y, (24, 43), (20, 6)) * front * rise(reach, 14.0, 20.0)),
        "brow_tilt": move(dy=0.15 * (x - 28.0) * brow),
        "lips": move(dy=0.30 * (y - MOUTH_Y) * mouth, dz=1.6 * bump(x, y, (0, MOUTH_Y), (15, 9)) * front),
        "mouth_width": move(0.16 * x * mouth),
        "mouth_forward": move(dz=3.5 * bump(x, y, (0, MOUTH_Y), (26, 20)) * front),
        "cheekbones": move(
            3.5 * bump(y, z, (0, 46), (13, 22)) * rise(x, 25.0, 58.0),
            dz=3.0 * bump(x, y, (46, 0), (13, 11)) * front * rise(reach, 14.0, 22.0),
        ),
        "cheeks": move(
            6.0 * bump(y, z, (-34, 44), (20, 24)) * rise(x, 20.0, 55.0),
            dz=4.0 * bump(x, y, (42, -34), (15, 18)) * front,
        ),
        "forehead": move(dy=0.06 * np.maximum(y - 50.0, 0.0), dz=4.5 * bump(x, y, (0, 78), (45, 22)) * front),
        "ears": move(4.0 * ear, 0.12 * (y - 6.0) * ear, -2.0 * ear),
    }


def dressed(face: Face, mesh: QuadMesh, complexion: Complexion) -> Array:
    """A person's head at rest (V, 3) with the hair as it is worn."""
    points = mesh.vertices.copy()
    shell, crown = hair_points(complexion.style)
    for name, positions in (("hair", shell), ("hair_crown", crown[None])):
        index = mesh.groups[name]
        points[index] = positions
        points[mesh.mirror[index]] = positions * [-1.0, 1.0, 1.0]
    middle = mesh.mirror == np.arange(len(points))
    points[middle, 0] = 0.0
    return face(points)


def coloured(mesh: QuadMesh, complexion: Complexion) -> NDArray[np.uint8]:
    """The head's colours (V, 3) in a person's complexion."""
    colours = mesh.colours.astype(np.float64)
    tone = np.array(SKIN_TONES[complexion.skin], dtype=np.float64)
    tint, hair_tint = tone / SKIN, np.array(HAIR_COLOURS[complexion.hair]) / np.array(HAIR)
    around = ("skin", "crown", "mouth_far", "mouth_near", "lip_border")
    colours[mesh.both(*around, "eye_", "ear_", "nostril", "lid_")] *= tint
    x, y, z = mesh.vertices.T
    if complexion.stubble:
        skin = mesh.both("skin", "mouth_far", "mouth_near")
        beard = rise(y, -4.0 - 0.2 * np.abs(x), -34.0) * rise(y, -128.0, -104.0) * rise(z, 8.0, 30.0)
        beard *= 1.0 - 0.85 * bump(np.abs(x), y, (30.0, -18.0), (12.0, 14.0))
        shadow = complexion.stubble * beard[skin, None]
        colours[skin] += shadow * (0.55 * tone + [8.0, 10.0, 12.0] - colours[skin])
    colours[mesh.both("lip_outer", "lip_crest", "lip_front", "lip_inner")] *= 0.45 + 0.55 * tint
    grid, share = mesh.groups["hair"], density(complexion.style)[:, None]
    # Strands differ from one another, and no two sides of a head are alike; neither are two places of skin.
    random = np.random.default_rng(0)
    scalp = (1.0 - share) * 0.9 * tone
    for side in (grid, mesh.mirror[grid]):
        light = np.tile(random.normal(1.0, STRANDS, HAIR_COLUMNS), HAIR_ROWS) * random.normal(1.0, 0.04, len(grid))
        colours[side] = share * (light / light.mean())[:, None] * hair_tint * mesh.colours[grid] + scalp
    mottled = mesh.both("skin", "mouth_far", "mouth_near", "ear_")
    colours[mottled] *= random.normal(1.0, MOTTLED, len(mottled))[:, None]
    colours[mottled, 1:] *= random.normal(1.0, MOTTLED, len(mottled))[:, None]
    colours[mesh.both("hair_crown")] *= hair_tint
    brow = np.array(HAIR) * (0.25 + 0.6 * np.minimum(hair_tint, 2.2))
    for name, peak in (("brow_0", 0.35), ("brow_1", 0.95), ("brow_2", 0.9), ("brow_3", 0.3)):
        dense = peak * np.interp(np.arange(BROW_COLUMNS), [0, 2, BROW_COLUMNS - 1], [0.35, 1.0, 0.8])[:, None]
        index = mesh.groups[name]
        colours[index] = colours[mesh.mirror[index]] = dense * brow + (1.0 - dense) * 0.93 * tone
    shirt = mesh.both("skin_shirt")
    colours[shirt] = SHIRTS[complexion.shirt]
    iris = np.array(EYE_COLOURS[complexion.eyes])
    for name in ("iris_rim", "iris_middle", "iris_inner"):
        average = mesh.colours[mesh.groups["iris_middle"]].mean(axis=0)
        colours[mesh.both(name)] *= iris / average
    # The upper lid shades the eye, and light gathers in the lower half of the iris.
    for name, below in (("ball_", 1.0), ("iris_", 1.3)):
        eye = mesh.both(name)
        colours[eye] *= (below + (LID_SHADOW - below) * rise(mesh.vertices[eye, 1] - EYE_CENTRE[1], -4.0, 4.5))[:, None]
    return np.asarray(np.clip(np.rint(colours), 0, 255), dtype=np.uint8)
