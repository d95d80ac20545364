"""The 52 names of ARKit's face and how others spell them.

Names are Apple's (developer documentation of ``ARFaceAnchor.BlendShapeLocation``). Their order and the columns beside
them are those of the CSV files that Epic's app Live Link Face records, as public readers of such files state them.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

_EYE = ("eyeBlink", "eyeLookDown", "eyeLookIn", "eyeLookOut", "eyeLookUp", "eyeSquint", "eyeWide")
ARKIT: tuple[str, ...] = (
    *(f"{name}Left" for name in _EYE),
    *(f"{name}Right" for name in _EYE),
    "jawForward",
    "jawRight",
    "jawLeft",
    "jawOpen",
    "mouthClose",
    "mouthFunnel",
    "mouthPucker",
    "mouthRight",
    "mouthLeft",
    "mouthSmileLeft",
    "mouthSmileRight",
    "mouthFrownLeft",
    "mouthFrownRight",
    "mouthDimpleLeft",
    "mouthDimpleRight",
    "mouthStretchLeft",
    "mouthStretchRight",
    "mouthRollLower",
    "mouthRollUpper",
    "mouthShrugLower",
    "mouthShrugUpper",
    "mouthPressLeft",
    "mouthPressRight",
    "mouthLowerDownLeft",
    "mouthLowerDownRight",
    "mouthUpperUpLeft",
    "mouthUpperUpRight",
    "browDownLeft",
    "browDownRight",
    "browInnerUp",
    "browOuterUpLeft",
    "browOuterUpRight",
    "cheekPuff",
    "cheekSquintLeft",
    "cheekSquintRight",
    "noseSneerLeft",
    "noseSneerRight",
    "tongueOut",
)
"""The names in the order of the recordings' columns."""

ROTATIONS: tuple[str, ...] = (
    *(f"Head{axis}" for axis in ("Yaw", "Pitch", "Roll")),
    *(f"{side}Eye{axis}" for side in ("Left", "Right") for axis in ("Yaw", "Pitch", "Roll")),
)
"""Columns that follow the names: turns of the head and the eyes."""

NEUTRAL = ("neutral", "basis", "rest", "base", "template")
"""Names (without case and punctuation) of the face at rest in a set of shapes."""


def live_link_name(name: str) -> str:
    """An ARKit name as the recordings capitalise it: ``jawOpen`` is ``JawOpen``."""
    return name[:1].upper() + name[1:]


def mirror_pairs(names: tuple[str, ...] = ARKIT) -> list[tuple[int, int]]:
    """Places (left, right) of the names that differ in their side only, for those whose other side is there too."""
    place = {name: index for index, name in enumerate(names)}
    return [
        (index, place[other])
        for name, index in place.items()
        if name.endswith("Left") and (other := f"{name.removesuffix('Left')}Right") in place
    ]


def arkit_name(name: str) -> str | None:
    """The ARKit name that a spelling stands for: ``EyeBlink_L``, ``jaw_open``, ``17 - browInnerUp``; None if none."""
    known = _spellings()
    for part in (name, re.split(r"[.:|]", name)[-1]):
        key = plain(part)
        if found := known.get(key) or known.get(key.lstrip("0123456789")):
            return found
    return None


def plain(name: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


@lru_cache(maxsize=1)
def _spellings() -> dict[str, str]:
    known = {plain(name): name for name in ARKIT}
    for name in ARKIT:
        for side in ("Left", "Right"):
            if name.endswith(side):
                known[plain(name.removesuffix(side)) + side[0].lower()] = name
    return known


def absent_from(names: Sequence[str]) -> tuple[str, ...]:
    """Names of ARKit's that are not among ``names``, in ARKit's order."""
    return tuple(name for name in ARKIT if name not in names)


def beyond_arkit(names: Sequence[str]) -> tuple[str, ...]:
    """Those of ``names`` that are not ARKit's."""
    return tuple(name for name in names if name not in ARKIT)
