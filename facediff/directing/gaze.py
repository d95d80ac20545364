"""Procedural gaze: fixations, and quick turns of both eyes between them.

A saccade of A degrees takes 21 ms + 2.2 ms · A (Carpenter, "Movements of the Eyes", 1988).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.directing.eyes import GIVE, Eyes, sphere_centre
from facediff.directing.layers import PROCEDURAL, Array, copied, noted, parts, random_of, smooth_step
from facediff.errors import FaceDiffError
from facediff.takes import Take

DEGREES = 4.0
"""Farthest from straight ahead if nothing is said: the eyes wander over a listener's face."""
WIDEST = 20.0
AHEAD_SECONDS, ASIDE_SECONDS = 1.6, 0.6
"""Mean duration of a fixation straight ahead, and elsewhere."""
SHORTEST = 0.2
"""Seconds between saccades at least."""
UPWARDS = 0.5
"""The eyes turn up and down less than sideways."""
LIDS_PER_DEGREE = 0.012
"""How far the lids close with each degree that the eyes look down, as a share of a full closing (up: they open)."""


def add_gaze(take: Take, eyes: Eyes, *, degrees: float = DEGREES, seed: int = 0) -> Take:
    """Let the eyes wander: eyeballs turn about their centres, lids follow slightly.

    Args:
        take: its head must not sway yet.
        eyes: of the take's topology; where the lids' closing is not known, they stay.
        degrees: how far from straight ahead the eyes turn at most.
        seed: equal seeds give equal gaze.

    Raises:
        FaceDiffError: if the angle is impossible, or the eyeballs are not known.
    """
    if not eyes.eyeballs:
        raise FaceDiffError(f"{eyes.source}: does not say which vertices are the eyeballs; {GIVE}")
    angles = gaze_curve(len(take.vertices), take.frame_rate, degrees=degrees, seed=seed)
    turns = gaze_rotations(angles)
    vertices = copied(take.vertices)
    for ball in eyes.eyeballs:
        rest = take.template[ball].astype(np.float64)
        centre = sphere_centre(rest)
        for part in parts(len(vertices)):
            # An eyeball that the take moves is turned where it is.
            moved = (vertices[part, ball] - rest).mean(axis=1)[:, None]
            arms = vertices[part, ball] - moved - centre
            vertices[part, ball] = arms @ turns[part].swapaxes(1, 2) + centre + moved
    if eyes.closing is not None:
        lids, closing = eyes.lids()
        follow = (-LIDS_PER_DEGREE * angles[:, 1]).astype(np.float32)
        for index in np.flatnonzero(follow):
            vertices[index, lids] += follow[index] * closing
    return noted(take, vertices, PROCEDURAL, f"gaze ({degrees:g} degrees, seed {seed})")


def gaze_curve(frames: int, frame_rate: float, *, degrees: float = DEGREES, seed: int = 0) -> Array:
    """Where the eyes look in every frame, (T, 2): degrees to the face's left and upwards.

    Fixations straight ahead and elsewhere take turns, now and then two elsewhere; it begins and ends straight ahead.

    Raises:
        FaceDiffError: if the angle is not above 0 and at most 20.
    """
    if not 0 < degrees <= WIDEST:
        raise FaceDiffError(f"--gaze {degrees:g}: expected degrees above 0 and up to {WIDEST:g}")
    random = random_of("gaze", seed)
    times = np.arange(frames) / frame_rate
    last = float(times[-1]) if frames else 0.0
    curve = np.zeros((frames, 2))
    here, now = np.zeros(2), _fixation(random, AHEAD_SECONDS)
    while now < last:
        elsewhere = not here.any() or random.random() < 0.25
        there = _target(random, degrees) if elsewhere else np.zeros(2)
        stay = _fixation(random, ASIDE_SECONDS if elsewhere else AHEAD_SECONDS)
        if now + stay >= last - SHORTEST:  # no time to come back
            there = np.zeros(2)
        seconds = 0.021 + 0.0022 * float(np.linalg.norm(there - here))
        first = int(now * frame_rate)
        curve[first:] = here + smooth_step((times[first:] - now) / seconds)[:, None] * (there - here)
        here, now = there, now + seconds + stay
    return curve


def _fixation(random: np.random.Generator, mean: float) -> float:
    return SHORTEST + float(random.gamma(2.0, (mean - SHORTEST) / 2.0))


def _target(random: np.random.Generator, degrees: float) -> Array:
    """Small turns are commoner than large ones; none is farther than ``degrees``."""
    size = degrees * min(1.0, 0.25 + float(random.exponential(0.35)))
    direction = random.uniform(0.0, 2.0 * np.pi)
    return np.array([size * np.cos(direction), UPWARDS * size * np.sin(direction)])


def gaze_rotations(angles: npt.NDArray[np.floating]) -> Array:
    """Rotations (T, 3, 3) that turn z to the left by the first and up by the second of the angles (T, 2) in degrees."""
    left, up = np.deg2rad(np.asarray(angles, np.float64)).T
    cos, sin, one, zero = np.cos, np.sin, np.ones_like(left), np.zeros_like(left)
    sideways = np.array([[cos(left), zero, sin(left)], [zero, one, zero], [-sin(left), zero, cos(left)]])
    upwards = np.array([[one, zero, zero], [zero, cos(up), sin(up)], [zero, -sin(up), cos(up)]])
    return np.asarray(np.moveaxis(sideways, 2, 0) @ np.moveaxis(upwards, 2, 0))
