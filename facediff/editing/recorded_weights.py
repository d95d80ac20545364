"""Recordings of ARKit's weights, such as a take of Live Link Face, as animations of the built-in face."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.animation import Animation
from facediff.editing.controls.procedural import move_head
from facediff.errors import FaceDiffError
from facediff.spaces.arkit import arkit_name
from facediff.spaces.decoding import ChannelDecoder
from facediff.spaces.files import even, from_start, read_parameters

SUFFIXES = (".csv", ".json")
"""Tables of Live Link Face or Audio2Face, and BEAT's files."""


def read_weights(path: Path) -> Animation:
    """Read a recording of ARKit's weights, and let the built-in face play it; the weights stay with the animation."""
    from facediff.synthetic.known_faces import built_in_rig

    clip = even(read_parameters(path))
    if clip.space.kind != "arkit":
        raise FaceDiffError(f"{path}: holds {clip.space.kind} parameters; expected weights of ARKit's shapes")
    rig = built_in_rig()
    # By ARKit's own spelling.
    space = replace(clip.space, channels=tuple(arkit_name(name) or name for name in clip.space.channels))
    moves = dict(zip(rig.names, rig.deltas, strict=True))
    deltas = np.stack([moves.get(space.channels[channel], np.zeros(rig.neutral.shape)) for channel in space.face])
    decoder = ChannelDecoder(space, np.zeros(len(space.channels)), rig.neutral, deltas)
    points = np.asarray(from_start(clip, clip.frame_rate), np.float32)[..., None]
    animation = Animation(
        path.stem,
        decoder.vertices(points),
        rig.neutral.astype(np.float32),
        clip.frame_rate,
        faces=None if rig.faces is None else rig.faces.astype(np.int32),
        unit=rig.unit,
        metadata={"face": "the built-in one, which plays recorded weights"},
    )
    turns = decoder.head_turns(points)
    if turns is not None and turns.any():
        animation = move_head(animation, turns, 0 * turns)
    return animation.made_of(space, decoder.values(points), decoder.deltas)
