"""The layouts in which programs and corpora write parameters: which channel stands in which column.

Several layouts share a width, so that an array without names is never taken for one of them by its shape. Orders,
rotations and rates are taken from the projects' code and files.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from facediff.errors import check_known
from facediff.spaces.arkit import ALPHABETICAL, ARKIT, ROTATIONS, left_first
from facediff.spaces.space import Form, Joint, Kind, Rotation, Space

Part = str | tuple[Joint, Form]

AXES = {
    "axis_angle": ("x", "y", "z"),
    "axis_angle_x": ("x",),
    "six_d": ("xx", "xy", "xz", "yx", "yy", "yz"),
    "quaternion": ("w", "x", "y", "z"),
    "euler": ("yaw", "pitch", "roll"),
}
"""Suffixes of a rotation's channels, after the joint."""


@dataclass(frozen=True)
class Layout:
    """The columns of files of a program or a corpus."""

    space: Space  # of the columns of the motion
    frame_rate: float | None = None  # frames a second where the layout has one rate only
    identity: int = 0  # leading columns of a flat array that are the person's and not motion
    # Of an archive, each array's name and the columns of it that are motion, in the space's order
    arrays: Mapping[str, slice] | None = None
    identity_array: str = ""  # name of the array of an archive that has the person's coefficients
    source: str = ""  # the programs or corpora that use it
    flat: bool = True  # whether it occurs as one array too; else as an archive only

    @property
    def width(self) -> int:
        """Columns of a flat array."""
        return self.identity + len(self.space.channels)


def parametric(kind: Kind, parts: Iterable[Part], *, version: str = "", identity: str = "") -> Space:
    """A space from its parts in order: ``"expression 50"``, a channel's name, or a joint with the form of its rotation.

    Example:
        >>> parametric("flame", ["expression 2", ("jaw", "axis_angle_x")]).channels
        ('expression_0', 'expression_1', 'jaw_x')
    """
    channels: list[str] = []
    rotations: list[Rotation] = []
    for part in parts:
        if isinstance(part, tuple):
            joint, form = part
            rotations.append(Rotation(joint, len(channels), form))
            channels += [f"{joint}_{axis}" for axis in AXES[form]]
            continue
        name, _, count = part.partition(" ")
        channels += [f"{name}_{index}" for index in range(int(count))] if count else [part]
    return Space(kind, tuple(channels), version, rotations=tuple(rotations), identity=identity)


def _arkit(names: tuple[str, ...], source: str) -> Layout:
    turns: dict[str, Joint] = {"HeadYaw": "head", "LeftEyeYaw": "left_eye", "RightEyeYaw": "right_eye"}
    rotations = tuple(Rotation(joint, names.index(name), "euler") for name, joint in turns.items() if name in names)
    lacking = tuple(name for name in ARKIT if name not in names)
    space = Space("arkit", names, "arkit", rotations=rotations, valid_range=(0.0, 1.0), absent=lacking)
    return Layout(space, None, source=source)


def _flame(*parts: Part, source: str, shape: int = 0, leading: int = 0, **more: object) -> Layout:
    identity = shape or leading
    space = parametric("flame", parts, identity=f"shape {identity}" if identity else "")
    return Layout(space, more.pop("frame_rate", 25.0), leading, source=source, **more)  # type: ignore[arg-type]


HEAD: Part = ("head", "axis_angle")
JAW: Part = ("jaw", "axis_angle")
_POSE = {"exp": slice(0, 50), "pose": slice(0, 6)}

LAYOUTS: dict[str, Layout] = {
    "arkit": _arkit(ALPHABETICAL, "EmoTalk, LAM, UniTalker's D3 and D4: 52 by the alphabet"),
    "arkit_51": _arkit(tuple(n for n in ALPHABETICAL if n != "tongueOut"), "BEAT, UniTalker's D6 and D7: no tongueOut"),
    "live_link": _arkit((*ARKIT, *ROTATIONS), "Live Link Face: 52, then yaw, pitch and roll of head and eyes"),
    "audio2face": _arkit(left_first(ARKIT), "Omniverse and Audio2Face: jaw and mouth to the left before the right"),
    "mediapipe": _arkit(
        ("_neutral", *(n for n in ALPHABETICAL if n != "tongueOut")), "MediaPipe: _neutral first, no tongueOut"
    ),
    "unitalker_d5": _flame(
        *("expression 100", JAW, ("head", "six_d"), "translation 3", "scale"),
        leading=300,
        frame_rate=30.0,
        source="UniTalker's D5 (DAD-3DHeads): shape 300, expression 100, jaw 3, head 6, translation 3, scale",
    ),
    "flame_diffposetalk": _flame(
        *("expression 50", HEAD, JAW), shape=100, arrays=_POSE, identity_array="shape", source="DiffPoseTalk's files"
    ),
    "flame_diffposetalk_model": _flame(
        *("expression 50", HEAD, ("jaw", "axis_angle_x")), source="DiffPoseTalk's network: of the jaw, x alone"
    ),
    "flame_diffposetalk_still": _flame(
        *("expression 50", ("jaw", "axis_angle_x")), source="DiffPoseTalk's network without head pose"
    ),
    "flame_artalk": _flame("expression 100", HEAD, JAW, source="ARTalk, EMICA: the head before the jaw"),
    "flame_unils": _flame(
        *("expression 100", HEAD, ("jaw", "axis_angle_x"), "eyelids 2", "eyes 2"), source="UniLS, ARTalk's training"
    ),
    "flame_dualtalk": _flame("expression 50", JAW, HEAD, source="DualTalk's predictions: the jaw before the head"),
    "flame_dualtalk_truth": _flame(
        *("expression 50", HEAD, JAW), arrays=_POSE, source="DualTalk's ground truth: the head before the jaw"
    ),
    "flame_emoca": _flame(
        *("expression 50", HEAD, JAW),
        shape=100,
        frame_rate=None,
        arrays=_POSE,
        identity_array="shape",
        source="EMOCA, DECA: the video's rate",
    ),
    "flame_emote": _flame("expression 100", JAW, source="EMOTE, FLINT"),
    "flame_3dmead": _flame("expression 100", JAW, leading=300, source="3DMEAD's flat form: shape 300 goes first"),
    "flame_3dmead_release": _flame(
        *("expression 100", HEAD, JAW),
        shape=300,
        arrays={"exp": slice(0, 100), "global_pose": slice(0, 3), "jaw": slice(0, 3)},
        identity_array="shape",
        source="3DMEAD's shape_pose_cam.hdf5 (EMOTE); the camera is left out",
        flat=False,
    ),
    "flame_beat2": _flame(
        *("expression 100", JAW),
        frame_rate=30.0,
        # Joint 22 of SMPL-X's 55 is the jaw.
        arrays={"expressions": slice(0, 100), "poses": slice(66, 69)},
        identity_array="betas",
        source="BEAT2: SMPL-X, whose jaw is a joint of the body",
    ),
}
"""The layouts by name."""


def find_layout(name: str, where: str = "layout") -> Layout:
    """A layout by its name."""
    check_known(where, "layout", [name], LAYOUTS)
    return LAYOUTS[name]


def layout(name: str) -> Space:
    """The space of a layout.

    Example:
        >>> layout("arkit_51").absent
        ('tongueOut',)
        >>> layout("flame_artalk").head
        (100, 101, 102)
    """
    return find_layout(name).space


def layouts_of_width(width: int) -> tuple[str, ...]:
    """The layouts with flat arrays of so many columns.

    Example:
        >>> layouts_of_width(56)
        ('flame_diffposetalk', 'flame_dualtalk', 'flame_dualtalk_truth', 'flame_emoca')
    """
    return tuple(name for name, entry in LAYOUTS.items() if entry.flat and entry.width == width)
