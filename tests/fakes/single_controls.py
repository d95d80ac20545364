"""Controls one by one on a whole animation, to compare with the package's, which applies all of them to stretches."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.options import AnimationControls
from facediff.cli.parsing import parameters_of, parse
from facediff.editing.controls import check_controls
from facediff.editing.controls.expressiveness import scaled_regions
from facediff.editing.controls.eyelids import Eyes
from facediff.editing.controls.procedural import (
    DEGREES_GAZE,
    DEGREES_SWAY,
    EDITED,
    PROCEDURAL,
    RATE,
    Amount,
    blinks_over_time,
    gaze_curve,
    in_words,
    move_head,
    shut_lids,
    sway_curve,
    turn_eyes,
    with_metadata,
)


def parsed(*words: str) -> AnimationControls:
    """The controls that the words of a command line ask for."""
    controls: AnimationControls = parse(parameters_of(with_controls), words, "animate")["controls"]
    check_controls(controls)
    return controls


def with_controls(*, controls: AnimationControls) -> None:
    """A command that has the controls only."""


def add_blinks(animation: Animation, eyes: Eyes, *, rate: Amount = RATE, seed: int = 0) -> Animation:
    """Let the eyes blink so many times a minute, in addition to any blinks of the animation."""
    vertices = shut_lids(animation, eyes, blinks_over_time(len(animation.vertices), animation.frame_rate, rate, seed))
    return with_metadata(animation, vertices, PROCEDURAL, f"blinks ({in_words(rate)} a minute, seed {seed})")


def add_gaze(animation: Animation, eyes: Eyes, *, degrees: Amount = DEGREES_GAZE, seed: int = 0) -> Animation:
    """Let the eyes wander: eyeballs turn about their centres, lids follow slightly where their closing is known."""
    angles = gaze_curve(len(animation.vertices), animation.frame_rate, degrees=degrees, seed=seed)
    note = f"gaze ({in_words(degrees)} degrees, seed {seed})"
    return with_metadata(animation, turn_eyes(animation, eyes, angles), PROCEDURAL, note)


def add_sway(animation: Animation, *, degrees: Amount = DEGREES_SWAY, seed: int = 0) -> Animation:
    """Let the head sway; all vertices move as one."""
    moved = move_head(animation, *sway_curve(len(animation.vertices), animation.frame_rate, degrees=degrees, seed=seed))
    return with_metadata(moved, moved.vertices, PROCEDURAL, f"head sway ({in_words(degrees)} degrees, seed {seed})")


def scale_regions(
    animation: Animation, factors: Mapping[str, float | npt.NDArray[np.floating]], eyes: Eyes | None = None
) -> Animation:
    """Scale how far every vertex goes from the neutral face."""
    words = ", ".join(f"{name} {in_words(value)}" for name, value in factors.items())
    return with_metadata(animation, scaled_regions(animation, factors, eyes), EDITED, f"expressiveness ({words})")
