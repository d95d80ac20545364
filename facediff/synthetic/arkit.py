"""ARKit's shapes for the built-in puppet's face, for those who have no blendshapes of their own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, choices
from facediff.synthetic.face import build_face
from facediff.synthetic.geometry import Array, rise
from facediff.synthetic.rig import CONTROLS, Shape, build_rig
from facediff.synthetic.speakers import SPEAKERS
from facediff.utils.files import atomic_folder

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
"""Controls that act on both sides, of which two shapes are made."""

BLEND = 0.005  # Half the width in metres of the strip about the midline over which a side's share goes from 0 to 1


def puppet_shapes(speaker: str | None = None) -> tuple[Array, npt.NDArray[np.int64], dict[str, Array]]:
    """A puppet's face at rest (V, 3) in metres, its triangles, and its shapes by ARKit's names, each (V, 3).

    ``mouthClose`` is what closes the lips when it is added to ``jawOpen``, as ARKit has it.

    Args:
        speaker: a speaker of the built-in corpus; the common face if None.

    Raises:
        FaceDiffError: if there is no such speaker.
    """
    if speaker is not None and speaker not in SPEAKERS:
        raise FaceDiffError(f'--identity: there is no speaker "{speaker}"; {choices(speaker, SPEAKERS)}')
    rig = build_rig(Shape() if speaker is None else SPEAKERS[speaker].shape)
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
    return neutral, np.asarray(mesh.faces, np.int64), shapes


def write_puppet_shapes(folder: Path, speaker: str | None = None) -> list[str]:
    """Write the shapes as OBJ files, and the face at rest as ``neutral.obj``; the folder appears whole or not at all.

    Returns:
        the names of the shapes.

    Raises:
        FaceDiffError: if the folder is there already or cannot be written, or there is no such speaker.
    """
    if folder.exists():
        raise FaceDiffError(f"{folder}: exists already; choose a new folder")
    neutral, faces, shapes = puppet_shapes(speaker)
    triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    with atomic_folder(folder) as temporary:
        for name, vertices in {"neutral": neutral, **shapes}.items():
            points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
            (temporary / f"{name}.obj").write_text(points + triangles, encoding="ascii")
    return list(shapes)
