"""ARKit's 52 shapes for the built-in puppet's face, for users without blendshapes of their own."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, choices
from facediff.synthetic.face import EYE_CENTRE, build_face
from facediff.synthetic.geometry import Array, HeadMesh, bump, rise
from facediff.synthetic.rig import CONTROLS, Shape, build_rig, jaw_share, lip_side, soft_parts
from facediff.synthetic.speakers import SPEAKERS

WHOLE = {
    "jawOpen": "jaw_open",
    "mouthFunnel": "funnel",
    "mouthPucker": "pucker",
    "mouthRollLower": "lower_lip_tuck",
    "mouthShrugLower": "chin_raise",
    "browInnerUp": "inner_brow_up",
    "cheekPuff": "cheek_puff",
}
"""Controls of the rig that are a shape by themselves."""

SIDED = {
    "eyeBlink": "lids_close",
    "eyeSquint": "squint",
    "eyeWide": "lids_wide",
    "mouthSmile": "corner_up",
    "mouthFrown": "corner_down",
    "mouthStretch": "stretch",
    "mouthPress": "lip_press",
    "mouthLowerDown": "lower_lip_drop",
    "mouthUpperUp": "upper_lip_raise",
    "browDown": "brow_frown",
    "browOuterUp": "outer_brow_up",
    "cheekSquint": "cheek_raise",
    "noseSneer": "nose_wrinkle",
}
"""Controls that act on both sides; each makes two shapes."""

LOOK_SIDEWAYS, LOOK_UP = 30.0, 25.0  # Degrees by which an eyeball is turned at weight 1
BLEND = 0.005  # Half the width in metres of the strip about the midline over which a side's share goes from 0 to 1


def puppet_shapes(speaker: str | None = None) -> tuple[Array, npt.NDArray[np.int64], dict[str, Array]]:
    """A puppet's face at rest (V, 3) in metres, its triangles, and its shapes by ARKit's names, each (V, 3).

    ``mouthClose`` is what closes the lips when it is added to ``jawOpen``, as ARKit has it. The puppet has no tongue:
    ``tongueOut`` is the face at rest.

    Args:
        speaker: a speaker of the built-in corpus; the common face if None.
    """
    if speaker is not None and speaker not in SPEAKERS:
        raise FaceDiffError(f'--identity: there is no speaker "{speaker}"; {choices(speaker, SPEAKERS)}')
    form = Shape() if speaker is None else SPEAKERS[speaker].shape
    rig = build_rig(form)
    mesh = build_face()
    poses = rig.pose(np.concatenate([np.zeros((1, len(CONTROLS))), np.eye(len(CONTROLS))]))
    neutral = poses[0]
    moves = dict(zip(CONTROLS, poses[1:] - neutral, strict=True))
    left = rise(mesh.vertices[:, 0] / BLEND, -1, 1)[:, None]
    shapes = {name: neutral + moves[control] for name, control in WHOLE.items()}
    for name, control in SIDED.items():
        shapes[f"{name}Left"] = neutral + left * moves[control]
        shapes[f"{name}Right"] = neutral + (1 - left) * moves[control]
    both = np.zeros((1, len(CONTROLS)))
    both[0, [CONTROLS.index("jaw_open"), CONTROLS.index("lip_closure")]] = 1.0
    shapes["mouthClose"] = neutral + rig.pose(both)[0] - shapes["jawOpen"]
    shapes |= {name: neutral + form(mesh.vertices + move) - form(mesh.vertices) for name, move in _moves(mesh).items()}
    return neutral, np.asarray(mesh.faces, np.int64), shapes


def _moves(mesh: HeadMesh) -> dict[str, Array]:
    """Displacements (V, 3) in metres of the neutral head for the shapes that the puppet's speech never uses."""
    canonical = 1000.0 * mesh.vertices
    x, y = canonical[:, 0], canonical[:, 1]
    below = lip_side(mesh, canonical)
    skin, inside = soft_parts(mesh, canonical)
    jaw = jaw_share(mesh, canonical, below)
    soft = skin * inside

    def move(dx: Array | float = 0.0, dy: Array | float = 0.0, dz: Array | float = 0.0) -> Array:
        return np.stack(np.broadcast_arrays(dx, dy, dz, np.zeros_like(x))[:3], axis=-1) / 1000.0

    def around(centre: tuple[float, float], width: tuple[float, float]) -> Array:
        return soft * bump(x, y, centre, width)

    mouth = around((0, -48), (26, 15))
    upper = around((0, -45), (22, 10)) * (1.0 - below)
    moves = {
        "jawForward": move(dz=6.0 * jaw),
        "jawLeft": move(6.0 * jaw),
        "jawRight": move(-6.0 * jaw),
        "mouthLeft": move(7.0 * mouth),
        "mouthRight": move(-7.0 * mouth),
        "mouthRollUpper": move(dy=-3.0 * upper, dz=-5.0 * upper),
        "mouthShrugUpper": move(dy=3.0 * upper, dz=2.0 * upper),
        "tongueOut": move(),
    }
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        corner = around((sign * 28, -48), (9, 11))
        moves[f"mouthDimple{side}"] = move(2.5 * sign * corner, 1.0 * corner, -4.0 * corner)
        inwards = -sign * LOOK_SIDEWAYS
        for name, turn in (
            ("In", (inwards, 0.0)),
            ("Out", (-inwards, 0.0)),
            ("Up", (0.0, LOOK_UP)),
            ("Down", (0.0, -LOOK_UP)),
        ):
            moves[f"eyeLook{name}{side}"] = _look(mesh, canonical, sign, *turn) / 1000.0
    return moves


def _look(mesh: HeadMesh, canonical: Array, sign: float, sideways: float, up: float) -> Array:
    """One eyeball turned about its centre, to the face's left and up in degrees: displacements (V, 3) in mm."""
    half = np.concatenate([at for name, at in mesh.groups.items() if name.startswith("eyeball") or name == "pupil"])
    ball = half if sign > 0 else mesh.mirror[half]
    about, lift = np.deg2rad(sideways), np.deg2rad(-up)
    around_y = np.array([[np.cos(about), 0, np.sin(about)], [0, 1, 0], [-np.sin(about), 0, np.cos(about)]])
    around_x = np.array([[1, 0, 0], [0, np.cos(lift), -np.sin(lift)], [0, np.sin(lift), np.cos(lift)]])
    points = canonical[ball] - np.array(EYE_CENTRE) * [sign, 1, 1]
    moved = np.zeros_like(canonical)
    moved[ball] = points @ (around_y @ around_x).T - points
    return moved
