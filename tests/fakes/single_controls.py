"""Controls one by one on a whole animation, to compare with the package's, which applies all of them to stretches."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.editing.controls.expressiveness import expressiveness_words, scaled_regions
from facediff.editing.controls.eyelids import Eyes
from facediff.editing.controls.procedural import (
    DEGREES_GAZE,
    DEGREES_SWAY,
    EDITED,
    PROCEDURAL,
    RATE,
    Amount,
    blink_words,
    blinks_over_time,
    gaze_over_time,
    gaze_words,
    move_head,
    shut_lids,
    sway_over_time,
    sway_words,
    turn_eyes,
    with_metadata,
)


def add_blinks(animation: Animation, eyes: Eyes, *, rate: Amount = RATE, seed: int = 0) -> Animation:
    """Let the eyes blink, in addition to any blinks of the animation, see :func:`shut_lids`.

    The head must not sway yet; ``rate`` is blinks a minute, 1 to 40, or as many of each frame, down to 0.
    """
    curve = blinks_over_time(len(animation.vertices), animation.frame_rate, rate, seed)
    vertices = shut_lids(animation, eyes, curve)
    return with_metadata(animation, vertices, PROCEDURAL, blink_words(rate, seed))


def add_gaze(animation: Animation, eyes: Eyes, *, degrees: Amount = DEGREES_GAZE, seed: int = 0) -> Animation:
    """Let the eyes wander: eyeballs turn about their centres, lids follow slightly where their closing is known.

    The head must not sway yet; ``degrees`` is how far from straight ahead the eyes turn at most, or that in each frame.
    """
    angles = gaze_over_time(len(animation.vertices), animation.frame_rate, degrees, seed)
    return with_metadata(animation, turn_eyes(animation, eyes, angles), PROCEDURAL, gaze_words(degrees, seed))


def add_sway(animation: Animation, *, degrees: Amount = DEGREES_SWAY, seed: int = 0) -> Animation:
    """Let the head sway, by ``degrees`` at most, or that in each frame; all vertices move as one.

    Nothing can be added after it.
    """
    turns, shifts = sway_over_time(len(animation.vertices), animation.frame_rate, degrees, seed)
    moved = move_head(animation, turns, shifts)
    return with_metadata(moved, moved.vertices, PROCEDURAL, sway_words(degrees, seed))


def scale_regions(
    animation: Animation, factors: Mapping[str, float | npt.NDArray[np.floating]], eyes: Eyes | None = None
) -> Animation:
    """Scale how far every vertex goes from the neutral face; arguments as in :func:`scaled_regions`."""
    return with_metadata(animation, scaled_regions(animation, factors, eyes), EDITED, expressiveness_words(factors))
