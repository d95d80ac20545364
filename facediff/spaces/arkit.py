"""ARKit's 52 shapes: one alphabet in several orders and spellings. Channels are always matched by name."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import lru_cache

# The 52 names are Apple's (developer documentation of ``ARFaceAnchor.BlendShapeLocation``). Their order and the further
# columns follow the CSV files that Epic's app Live Link Face records, as public readers of such files state them.

_EYE = "eyeBlink{0} eyeLookDown{0} eyeLookIn{0} eyeLookOut{0} eyeLookUp{0} eyeSquint{0} eyeWide{0}"
_FACE = """
    jawForward jawRight jawLeft jawOpen mouthClose mouthFunnel mouthPucker mouthRight mouthLeft
    mouthSmileLeft mouthSmileRight mouthFrownLeft mouthFrownRight mouthDimpleLeft mouthDimpleRight
    mouthStretchLeft mouthStretchRight mouthRollLower mouthRollUpper mouthShrugLower mouthShrugUpper
    mouthPressLeft mouthPressRight mouthLowerDownLeft mouthLowerDownRight mouthUpperUpLeft mouthUpperUpRight
    browDownLeft browDownRight browInnerUp browOuterUpLeft browOuterUpRight cheekPuff cheekSquintLeft cheekSquintRight
    noseSneerLeft noseSneerRight tongueOut
"""
ARKIT: tuple[str, ...] = (*_EYE.format("Left").split(), *_EYE.format("Right").split(), *_FACE.split())
"""The names in the order of the recordings' columns."""

ALPHABETICAL: tuple[str, ...] = tuple(sorted(ARKIT, key=str.lower))

LEFT_AND_RIGHT: tuple[str, ...] = tuple(
    name.removesuffix("Left") for name in ARKIT if name.endswith("Left") and name not in ("jawLeft", "mouthLeft")
)
"""Names, without their side, of shapes that exist for the left and the right half of a face."""

ROTATIONS: tuple[str, ...] = (
    *(f"Head{axis}" for axis in ("Yaw", "Pitch", "Roll")),
    *(f"{side}Eye{axis}" for side in ("Left", "Right") for axis in ("Yaw", "Pitch", "Roll")),
)
"""Columns that follow the names: rotations of the head and the eyes."""


def left_first(names: Sequence[str]) -> tuple[str, ...]:
    """Names of the recordings' order with left before right for jaw and mouth too, as senders and Omniverse have it."""
    order = list(names)
    for left, right in (("jawLeft", "jawRight"), ("mouthLeft", "mouthRight")):
        first = min(order.index(left), order.index(right))
        order[first : first + 2] = [left, right]
    return tuple(order)


def live_link_name(name: str) -> str:
    """An ARKit name as Live Link Face capitalises it: ``jawOpen`` becomes ``JawOpen``."""
    return name[:1].upper() + name[1:]


def mirror_pairs(names: tuple[str, ...] = ARKIT) -> list[tuple[int, int]]:
    """Indices (left, right) of the names that differ in their side only."""
    index_of = {name: index for index, name in enumerate(names)}
    return [
        (index, index_of[right])
        for name, index in index_of.items()
        if name.endswith("Left") and (right := f"{name.removesuffix('Left')}Right") in index_of
    ]


def arkit_name(name: str) -> str | None:
    """The ARKit name that a spelling stands for: ``EyeBlink_L``, ``jaw_open``, ``17 - browInnerUp``; None if none."""
    # Leading digits number the shapes; after a dot, a colon or a bar stands the shape's name within a node.
    spellings = _spellings()
    for part in (name, re.split(r"[.:|]", name)[-1]):
        key = plain(part)
        if arkit := spellings.get(key) or spellings.get(key.lstrip("0123456789")):
            return arkit
    return None


def plain(name: str) -> str:
    """A name without case and punctuation."""
    return re.sub(r"[^a-z0-9]", "", name.lower())


@lru_cache(maxsize=1)
def _spellings() -> dict[str, str]:
    spellings = {plain(name): name for name in ARKIT}
    for name in ARKIT:
        for side in ("Left", "Right"):
            if name.endswith(side):
                spellings[plain(name.removesuffix(side)) + side[0].lower()] = name
    return spellings


def absent_from(names: Sequence[str]) -> tuple[str, ...]:
    """Names of ARKit's that are not among ``names``, in ARKit's order."""
    return tuple(name for name in ARKIT if name not in names)


def beyond_arkit(names: Sequence[str]) -> tuple[str, ...]:
    """The names that are not ARKit's."""
    return tuple(name for name in names if name not in ARKIT)
