"""Facts of a face for a page: to pose it, motion that rules have already added to a take, and weights."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import PHONEMES
from facediff.editing.controls import direction, procedural
from facediff.editing.controls.brows import brows_of
from facediff.editing.controls.controlled_face import ACTED
from facediff.editing.controls.eyelids import puppet_eyes
from facediff.editing.controls.face_shapes import own_shapes
from facediff.errors import FaceDiffError
from facediff.export.viewer.packing import Blobs, millimetres
from facediff.utils.plain_files import parse_json

FIELD_STEP = 0.01
"""Quantisation of displacements in mm: a vertex is off by less than 0.01 mm at a weight of 1."""
ACTING = re.compile(r"brow and head acting \((.+), seed ([0-9]+)\)")
BLINKS = re.compile(r"blinks \(([0-9.]+) a minute, seed ([0-9]+)\)")
"""How :meth:`~facediff.editing.controls.controlled_face.ControlledFace.amounts` names them in metadata."""


def pose_fields(animation: Animation, blobs: Blobs) -> dict[str, Any] | None:
    """Displacements of a built-in face in steps, as numbers of blobs: of brows, lids and ARKit's shapes.

    For other faces ``facediff animate`` carries them over, which takes seconds; a page does without.
    """
    shapes = own_shapes(animation.template, animation.faces)
    eyes = puppet_eyes(animation.template, animation.faces)
    if shapes is None or eyes is None or eyes.closing is None:
        return None
    brows = brows_of(animation.template, animation.faces, animation.regions, animation.unit, eyes)
    lids, _ = eyes.lids()
    closing = np.zeros_like(eyes.closing)
    closing[lids] = eyes.closing[lids]

    def packed(field: npt.NDArray[np.floating]) -> int:
        # One axis after the other: most of a shape is zero, and deflate keeps that short.
        return blobs.add(np.rint((field * millimetres(animation)).T / FIELD_STEP).astype("<i2").tobytes())

    return {
        "step": FIELD_STEP,
        "widened": procedural.WIDENED,
        "browsUp": packed(brows.up),
        "browsDown": packed(brows.down),
        "closing": packed(closing),
        "shapes": {name: packed(field) for name, field in shapes.items()},
    }


def acted_curves(animation: Animation, blobs: Blobs) -> dict[str, Any] | None:
    """What acting and blinking added to the keys' channels, frame by frame; None if neither did, or it is not known."""
    text = animation.metadata.get(procedural.PROCEDURAL, "")
    frames, curves = len(animation.vertices), dict[str, npt.NDArray[np.float64]]()
    blinks = None
    try:
        if (acting := ACTING.search(text)) and animation.speech is not None:
            from facediff.editing.acting import act, read_acting

            curves = dict(zip(ACTED, act(read_acting(acting[1]), animation, int(acting[2])).T, strict=True))
        if rule := BLINKS.search(text):
            blinks = procedural.blinks_over_time(frames, animation.frame_rate, float(rule[1]), int(rule[2]))
    except (FaceDiffError, ValueError):  # metadata from elsewhere may say anything
        return None
    if not curves and blinks is None:
        return None
    return {
        "acting": {name: blobs.add(curve.astype("<f4").tobytes()) for name, curve in curves.items()},
        "blinks": None if blinks is None else blobs.add(blinks.astype("<f4").tobytes()),
    }


def sounds(animations: Sequence[Animation]) -> list[list[Any]]:
    """Rows of start, end, phoneme and word of the first animation that has them; empty if none has."""
    for animation in animations:
        with suppress(FaceDiffError):  # metadata from elsewhere may say anything
            rows = parse_json(animation.metadata.get(PHONEMES, "[]"), animation.name)
            if rows and isinstance(rows, list) and all(map(_is_sound, rows)):
                return rows
    return []


def _is_sound(row: object) -> bool:
    match row:
        case [int() | float(), int() | float(), str(), str()]:
            return True
    return False


def moods() -> dict[str, list[dict[str, float | str]]]:
    """The keys of each mood, as rows of a file."""
    return {name: direction.Direction(keys).rows() for name, keys in direction.MOODS.items()}


def channel_facts(animation: Animation, blobs: Blobs) -> dict[str, Any] | None:
    """Weights of ARKit's shapes as a page keeps them for its archive; None for other motion."""
    values = animation.values
    if values is None or animation.space.kind != "arkit":
        return None
    return {
        "space": animation.space.state(),
        "channels": len(animation.space.channels),
        "values": blobs.add(values.astype("<f4").tobytes()),
    }
