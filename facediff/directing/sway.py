"""Procedural head sway: slow, small turns and shifts of the whole head."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.directing.layers import PROCEDURAL, SWAYS, Array, noted, random_of, room_for, smooth_step
from facediff.errors import FaceDiffError
from facediff.takes import Take
from facediff.topology.flame import rotations

DEGREES = 2.0
"""Largest turn if nothing is said."""
WIDEST = 15.0
BAND = (0.08, 0.6)
"""Hertz: slower cannot be seen, quicker is a tremble."""
WAVES = 6
AXES = np.array([0.7, 1.0, 0.5])
"""How much of the turning is nodding, shaking and tilting."""
SHIFT = 0.004
"""Largest shift for each degree of turning, as a share of the head's height: about a millimetre."""
AT_REST = 1.0
"""Seconds over which the sway swells and dies away."""


def add_sway(take: Take, *, degrees: float = DEGREES, seed: int = 0) -> Take:
    """Let the head sway; all vertices move as one. It is the last change to a take: nothing can be laid on it after.

    Args:
        take: any take.
        degrees: largest turn.
        seed: equal seeds give equal sway.

    Raises:
        FaceDiffError: if the angle is impossible.
    """
    turns, shifts = sway_curve(len(take.vertices), take.frame_rate, degrees=degrees, seed=seed)
    matrices = rotations(turns)
    template = np.asarray(take.template, np.float64)
    pivot, height = neck(template), float(np.ptp(template[:, 1]))
    vertices = room_for(take.vertices)
    for index, frame in enumerate(take.vertices):
        moving = turns[index].any() or shifts[index].any()  # at rest to the last bit
        vertices[index] = (frame - pivot) @ matrices[index].T + pivot + height * shifts[index] if moving else frame
    return noted(take, vertices, PROCEDURAL, f"{SWAYS} ({degrees:g} degrees, seed {seed})")


def neck(template: npt.NDArray[np.floating]) -> Array:
    """Where a head (V, 3) turns: low in its middle, and well behind the face, also where the mesh has no back."""
    low, high = template.min(axis=0), template.max(axis=0)
    height = high[1] - low[1]
    return np.array([0.5 * (low[0] + high[0]), low[1] + 0.15 * height, high[2] - 0.6 * height])


def sway_curve(frames: int, frame_rate: float, *, degrees: float = DEGREES, seed: int = 0) -> tuple[Array, Array]:
    """Turns (T, 3), axis-angle in radians, and shifts (T, 3), in head heights; zero in the first and the last frame.

    Sums of six sines between 0.08 and 0.6 Hz, so that nothing is quick; the largest turn is ``degrees``.

    Raises:
        FaceDiffError: if the angle is not above 0 and at most 15.
    """
    if not 0 < degrees <= WIDEST:
        raise FaceDiffError(f"--sway {degrees:g}: expected degrees above 0 and up to {WIDEST:g}")
    random = random_of("sway", seed)
    times = np.arange(frames) / frame_rate
    last = float(times[-1]) if frames else 0.0
    ramp = max(min(AT_REST, last / 3.0), 1e-6)
    rest = smooth_step(times / ramp) * smooth_step((last - times) / ramp)
    rates = random.uniform(*BAND, (6, WAVES))
    phases = random.uniform(0.0, 2.0 * np.pi, (6, WAVES))
    waves = np.sin(2.0 * np.pi * rates * times[:, None, None] + phases).sum(axis=-1) * rest[:, None]
    turns, shifts = waves[:, :3] * AXES, waves[:, 3:]
    return _largest(turns, np.deg2rad(degrees)), _largest(shifts, SHIFT * degrees)


def _largest(vectors: Array, size: float) -> Array:
    """Vectors (T, 3) scaled so that the longest has a size."""
    longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
    return vectors * (size / longest) if longest > 0 else vectors
