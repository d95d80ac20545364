"""Visemes from ARKit's weights, for avatars that have no ARKit shapes: Oculus' 15, and VRM's vowels and blinks.

The map is ours. A viseme is a pose of a few ARKit weights, written below after how the sound is articulated; the tongue
behind the teeth, which ARKit has no shape for, is left out. With the poses as rows of P (K, C), weights x (C,) become
viseme weights x Pᵀ (P Pᵀ + λ I)⁻¹, the least-squares combination of poses with a small ridge λ, without which sounds
that differ by the tongue alone (DD, nn, kk) would cancel each other with large weights. It is linear; weights
are clipped to 0 to 1. "sil" is the remainder to 1.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Literal

import numpy as np

from facediff.spaces.arkit import ALPHABETICAL, LEFT_AND_RIGHT
from facediff.spaces.layouts import layout
from facediff.spaces.operations import permuted
from facediff.spaces.space import Space
from facediff.utils.numerics import Array, Floats

Values = Floats
VisemeSet = Literal["oculus", "vrm"]

RIDGE = 0.02

OCULUS: dict[str, dict[str, float]] = {
    "PP": {"mouthPress": 0.6, "mouthRollLower": 0.3, "mouthRollUpper": 0.3},
    "FF": {"mouthRollLower": 0.6, "mouthUpperUp": 0.3, "jawOpen": 0.05},
    "TH": {"tongueOut": 0.5, "jawOpen": 0.15, "mouthLowerDown": 0.1},
    "DD": {"jawOpen": 0.12, "mouthLowerDown": 0.3, "mouthUpperUp": 0.1},
    "kk": {"jawOpen": 0.2, "mouthShrugUpper": 0.2, "mouthLowerDown": 0.1},
    "CH": {"mouthFunnel": 0.5, "mouthPucker": 0.2, "mouthUpperUp": 0.2, "mouthLowerDown": 0.2, "jawOpen": 0.05},
    "SS": {"mouthStretch": 0.4, "mouthUpperUp": 0.3, "mouthLowerDown": 0.3, "jawOpen": 0.03},
    "nn": {"jawOpen": 0.1, "mouthShrugLower": 0.2, "mouthLowerDown": 0.15},
    "RR": {"mouthFunnel": 0.3, "mouthShrugLower": 0.3, "jawOpen": 0.12, "mouthPucker": 0.1},
    "aa": {"jawOpen": 0.65, "mouthLowerDown": 0.3, "mouthUpperUp": 0.2},
    "E": {"jawOpen": 0.3, "mouthStretch": 0.3, "mouthDimple": 0.2, "mouthLowerDown": 0.2, "mouthUpperUp": 0.15},
    "ih": {"jawOpen": 0.15, "mouthSmile": 0.4, "mouthDimple": 0.2, "mouthStretch": 0.1},
    "oh": {"jawOpen": 0.4, "mouthFunnel": 0.6},
    "ou": {"jawOpen": 0.15, "mouthPucker": 0.8, "mouthFunnel": 0.3},
}
"""Weights of each viseme's pose; names without a side stand for both."""

VRM = {"A": OCULUS["aa"], "I": OCULUS["ih"], "U": OCULUS["ou"], "E": OCULUS["E"], "O": OCULUS["oh"]}
"""The vowels under the names that VRM 0 and the VMC protocol have; VRM 1 calls them aa, ih, ou, ee and oh."""
BLINKS = ("Blink", "Blink_L", "Blink_R")

SETS: dict[str, tuple[str, ...]] = {"oculus": ("sil", *OCULUS), "vrm": (*VRM, *BLINKS)}
"""Names of the visemes of each set, in order."""


def poses(viseme_set: VisemeSet) -> Array:
    """The poses (K, 52) of a set, in ARKit's alphabetical order; without sil and blinks."""
    rows = []
    for pose in (OCULUS if viseme_set == "oculus" else VRM).values():
        sides = {
            f"{name}{side}": weight
            for name, weight in pose.items()
            for side in (("Left", "Right") if name in LEFT_AND_RIGHT else ("",))
        }
        rows.append([sides.get(name, 0.0) for name in ALPHABETICAL])
    return np.array(rows)


@lru_cache(maxsize=2)
def viseme_map(viseme_set: VisemeSet) -> Array:
    """The linear map (52, K) from weights in ARKit's alphabetical order; see the module."""
    rows = poses(viseme_set)
    return np.asarray(rows.T @ np.linalg.inv(rows @ rows.T + RIDGE * np.eye(len(rows))))


def visemes(values: Values, space: Space, viseme_set: VisemeSet) -> tuple[Values, Space]:
    """Weights of visemes (T, K) from weights of ARKit's shapes (T, C).

    Args:
        values: the weights, in a space of ARKit's, in any order.
        space: their space.
        viseme_set: ``oculus`` for sil, PP, FF … ou, ``vrm`` for A, I, U, E, O and blinks. VRM's Blink is the smaller
            closure of both eyes, and Blink_L and Blink_R are the rest of either, since avatars add them up.

    Example:
        >>> open_mouth = np.array([[0.65, 0.3, 0.3]])
        >>> space = Space("arkit", ("jawOpen", "mouthLowerDownLeft", "mouthLowerDownRight"))
        >>> weights, names = visemes(open_mouth, space, "vrm")
        >>> names.channels[int(weights[0].argmax())]
        'A'
    """
    weights = permuted(values, space, layout("arkit"))[0]
    shares = np.clip(weights @ viseme_map(viseme_set), 0.0, 1.0)
    if viseme_set == "oculus":
        shares = np.concatenate([np.clip(1.0 - shares.sum(1, keepdims=True), 0.0, 1.0), shares], axis=1)
    else:
        left, right = (weights[:, [ALPHABETICAL.index(f"eyeBlink{side}")]] for side in ("Left", "Right"))
        left, right = np.clip(left, 0, 1), np.clip(right, 0, 1)
        blink = np.minimum(left, right)
        shares = np.concatenate([shares, blink, left - blink, right - blink], axis=1)
    names = SETS[viseme_set]
    return np.asarray(shares, values.dtype), Space("linear", names, viseme_set, valid_range=(0.0, 1.0))
