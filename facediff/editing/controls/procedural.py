"""Procedural blinks, gaze and head sway: motion made by rules on top of a finished animation, and not learnt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.animation.animation import allocate_like
from facediff.editing.controls.eyelids import Eyes
from facediff.mesh.flame import rotations
from facediff.utils import ranges
from facediff.utils.numerics import Array, Floats, smooth_step

PROCEDURAL = "procedural"  # Metadata key: motion added by rules
EDITED = "edited"  # Metadata key: changes of the animation's own motion
SWAYS = "head sway"
"""Name of a swaying head in the metadata; such an animation moves as a whole, so that nothing can be added any more."""
MOVED_HEAD = (SWAYS, "head keys", "head acting")
"""Names in the metadata of all motion of the head."""

Amount = float | Floats
"""A number, or one for each frame (T,)."""

# Streams of random numbers of a seed: adding or omitting another layer does not change a layer's.
BLINKS, GAZE, SWAY, KEEPS_BLINK = 1, 2, 3, 5


# Blinks. How often people blink is from Bentivoglio et al., "Analysis of blink rate patterns in normal subjects",
# Movement Disorders 12(6), 1997: 17 times a minute at rest, 26 in conversation, 4.5 when reading.

RATE = 17.0  # Blinks a minute at rest
CLOSE, SHUT, OPEN = 0.10, 0.03, 0.20
"""Seconds that the lids take to shut, stay shut, and take to open: about a third of a second, quicker down than up."""
SPREAD = (0.85, 1.2)  # How much shorter and longer than that a blink may be
GAP = 0.15  # Seconds from one blink's end to the next one's start at least
DOUBLE = 0.12  # Share of blinks that another one follows immediately
WIDENED = -0.5
"""How far an eye may be open beyond the neutral face, as a share of a closing, so that a blink still shuts it."""


def shut_lids(animation: Animation, eyes: Eyes, curve: Floats) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3) with the eyes shut as far as a curve (T,) says, 0 to 1.

    The lids' own closing a and the curve's b make a + b (1 − a): at b = 0 the animation's own, at b = 1 shut, never
    more. An eye that is shut already stays as it is.
    """
    lids, closing = eyes.lids()
    vertices = copied(animation.vertices)
    size = (closing**2).sum(axis=-1)
    for index in np.flatnonzero(curve):
        offsets = vertices[index, lids] - animation.template[lids]
        shut = np.clip((offsets * closing).sum(axis=-1) / size, WIDENED, 1.0)
        vertices[index, lids] += ((1.0 - shut) * np.float32(curve[index]))[:, None] * closing
    return vertices


def blinks_over_time(frames: int, frame_rate: float, rate: Amount, seed: int) -> Array:
    """How far the eyes are shut in every frame (T,) at a rate that may change from frame to frame.

    Of the blinks at the highest rate, each is kept with the chance of the rate at its time over the highest (thinning;
    Lewis and Shedler, "Simulation of nonhomogeneous Poisson processes by thinning", Naval Research Logistics Quarterly
    26(3), 1979): a rate that never changes keeps them all.
    """
    if not isinstance(rate, np.ndarray):
        return blink_curve(frames, frame_rate, rate=rate, seed=seed)
    highest = max(float(rate.max(initial=0.0)), 1.0)
    return blink_curve(frames, frame_rate, rate=highest, seed=seed, chances=rate / highest)


@ranges.checked
def blink_curve(
    frames: int, frame_rate: float, *, rate: ranges.BlinkRate = RATE, seed: int = 0, chances: Floats | None = None
) -> Array:
    """How far the eyes are shut in every frame (T,), 0 to 1, at a number of blinks a minute.

    Intervals are a gamma distribution of shape 2 above the shortest possible one, with the mean that the rate asks for.
    No two blinks overlap, none begins before the first frame or ends after the last, each is fully shut for a frame.

    Args:
        frames: T.
        frame_rate: frames a second.
        rate: blinks a minute.
        seed: of the random numbers.
        chances: probability (T,) of keeping a blink that begins in a frame; all are kept if None.
    """
    random, chance = (np.random.default_rng([seed, stream]) for stream in (BLINKS, KEEPS_BLINK))
    times = np.arange(frames) / frame_rate
    last = times[-1] if frames else 0.0
    hold = max(SHUT, 1.0 / frame_rate)  # so that one frame at least falls into it
    duration = CLOSE + hold + OPEN
    least = duration * SPREAD[1] + GAP
    # A double blink is two for one interval; the mean of all intervals from start to start stays 60 / rate.
    mean = 60.0 * (1.0 + DOUBLE) / rate - DOUBLE * (duration + GAP)
    curve = np.zeros(frames)
    start = random.uniform(0.0, 1.0) * mean
    while start < last:
        for _ in range(2 if random.random() < DOUBLE else 1):
            length = float(random.uniform(*SPREAD))
            down, up = CLOSE * length, OPEN * length
            end = start + down + hold + up
            keeps = chances is None or chance.random() < chances[min(int(start * frame_rate), frames - 1)]
            if end <= last and keeps:
                span = slice(int(start * frame_rate), int(end * frame_rate) + 2)
                shut = smooth_step((times[span] - start) / down) * smooth_step((end - times[span]) / up)
                curve[span] = np.maximum(curve[span], shut)
            following, start = start, end + GAP
        start = following + least + float(random.gamma(2.0, max(mean - least, 0.05) / 2.0))
    return curve


# Gaze: fixations, and quick turns of both eyes (saccades) between them. A saccade of A degrees takes 21 ms + 2.2 ms · A
# (Carpenter, "Movements of the Eyes", 1988).

DEGREES_GAZE = 4.0  # Default of the largest angle from straight ahead: the eyes wander over a listener's face
AHEAD_SECONDS, ASIDE_SECONDS = 1.6, 0.6  # Mean duration of a fixation straight ahead, and elsewhere
SHORTEST = 0.2  # Seconds between saccades at least
CHUNK = 256  # Frames that are turned at a time
UPWARDS = 0.5  # The eyes turn up and down less than sideways
LIDS_PER_DEGREE = 0.012
"""How far the lids close with each degree that the eyes look down, as a share of a full closing (up: they open)."""


def turn_eyes(animation: Animation, eyes: Eyes, angles: Floats) -> npt.NDArray[np.float32]:
    """Vertices (T, V, 3) with eyeballs that are turned by angles (T, 2), and lids that follow them."""
    turns = gaze_rotations(angles)
    vertices = copied(animation.vertices)
    for ball in eyes.eyeballs:
        rest = animation.template[ball].astype(np.float64)
        centre = sphere_centre(rest)
        for first in range(0, len(vertices), CHUNK):
            part = slice(first, first + CHUNK)
            # An eyeball that the animation moves is turned where it is.
            moved = (vertices[part, ball] - rest).mean(axis=1)[:, None]
            arms = vertices[part, ball] - moved - centre
            vertices[part, ball] = arms @ turns[part].swapaxes(1, 2) + centre + moved
    if eyes.closing is not None:
        lids, closing = eyes.lids()
        follow = (-LIDS_PER_DEGREE * angles[:, 1]).astype(np.float32)
        for index in np.flatnonzero(follow):
            vertices[index, lids] += follow[index] * closing
    return vertices


def gaze_curve(frames: int, frame_rate: float, *, degrees: Amount = DEGREES_GAZE, seed: int = 0) -> Array:
    """Where the eyes look in every frame, (T, 2): degrees to the face's left and upwards, up to a largest angle.

    Fixations straight ahead and elsewhere alternate, now and then with two elsewhere; the first and the last are
    straight ahead.
    """
    random, (largest, share) = np.random.default_rng([seed, GAZE]), largest_of(degrees)

    def fixation(mean: float) -> float:
        return SHORTEST + float(random.gamma(2.0, (mean - SHORTEST) / 2.0))

    def somewhere() -> Array:
        # Small turns are commoner than large ones.
        size = largest * min(1.0, 0.25 + float(random.exponential(0.35)))
        direction = random.uniform(0.0, 2.0 * np.pi)
        return np.array([size * np.cos(direction), UPWARDS * size * np.sin(direction)])

    times = np.arange(frames) / frame_rate
    last = float(times[-1]) if frames else 0.0
    curve = np.zeros((frames, 2))
    gaze, time = np.zeros(2), fixation(AHEAD_SECONDS)
    while time < last:
        elsewhere = not gaze.any() or random.random() < 0.25
        goal = somewhere() if elsewhere else np.zeros(2)
        stay = fixation(ASIDE_SECONDS if elsewhere else AHEAD_SECONDS)
        if time + stay >= last - SHORTEST:  # too late to return
            goal = np.zeros(2)
        seconds = 0.021 + 0.0022 * float(np.linalg.norm(goal - gaze))
        first = int(time * frame_rate)
        curve[first:] = gaze + smooth_step((times[first:] - time) / seconds)[:, None] * (goal - gaze)
        gaze, time = goal, time + seconds + stay
    return np.asarray(share * curve)


def gaze_rotations(angles: Floats) -> Array:
    """Rotations (T, 3, 3) that turn z to the left by the first and up by the second of the angles (T, 2) in degrees."""
    left, up = np.deg2rad(np.asarray(angles, np.float64)).T
    cos, sin, one, zero = np.cos, np.sin, np.ones_like(left), np.zeros_like(left)
    sideways = np.array([[cos(left), zero, sin(left)], [zero, one, zero], [-sin(left), zero, cos(left)]])
    upwards = np.array([[one, zero, zero], [zero, cos(up), sin(up)], [zero, -sin(up), cos(up)]])
    return np.asarray(np.moveaxis(sideways, 2, 0) @ np.moveaxis(upwards, 2, 0))


def sphere_centre(points: Floats) -> Array:
    """Centre (3,) of the sphere nearest to points (N, 3), which may be a part of it only, by linear least squares."""
    # |x − c|² = r² is linear in c and r² − |c|²: 2 x·c + (r² − |c|²) = |x|².
    middle = np.asarray(points, np.float64).mean(axis=0)
    local = np.asarray(points, np.float64) - middle
    system = np.concatenate([2.0 * local, np.ones((len(local), 1))], axis=1)
    return np.asarray(middle + np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0][:3])


# Head sway: slow, small rotations and shifts of the whole head.

DEGREES_SWAY = 2.0  # Default of the largest rotation
BAND = (0.08, 0.6)  # Hertz: slower sway cannot be seen, and faster sway looks like a tremor
WAVES = 6
AXES = np.array([0.7, 1.0, 0.5])  # How much of the rotation is nodding, shaking and tilting
SHIFT = 0.004  # Largest shift for each degree of rotation, as a share of the head's height: about a millimetre
AT_REST = 1.0  # Seconds over which the sway begins and ends


def move_head(animation: Animation, turns: Array, shifts: Array) -> Animation:
    """The animation with vertices that move as one.

    Args:
        animation: with a head that does not move yet.
        turns: rotations about the neck (T, 3), axis-angle in radians.
        shifts: (T, 3) in head heights.
    """
    matrices = rotations(turns)
    template = np.asarray(animation.template, np.float64)
    pivot, height = neck(template), float(np.ptp(template[:, 1]))
    vertices = allocate_like(animation.vertices)
    for index, frame in enumerate(animation.vertices):
        moving = turns[index].any() or shifts[index].any()  # at rest to the last bit
        vertices[index] = (frame - pivot) @ matrices[index].T + pivot + height * shifts[index] if moving else frame
    shift = pivot + height * np.asarray(shifts, np.float64) - np.einsum("tij,j->ti", matrices, pivot)
    shift[~(turns.any(axis=1) | shifts.any(axis=1))] = 0.0
    return replace(animation, vertices=vertices, head=np.concatenate([turns, shift], axis=1))


def neck(template: Floats) -> Array:
    """Where a head (V, 3) turns: low in its middle, and well behind the face, also where the mesh has no back."""
    low, high = template.min(axis=0), template.max(axis=0)
    height = high[1] - low[1]
    return np.array([0.5 * (low[0] + high[0]), low[1] + 0.15 * height, high[2] - 0.6 * height])


def sway_curve(frames: int, frame_rate: float, *, degrees: Amount = DEGREES_SWAY, seed: int = 0) -> tuple[Array, Array]:
    """Rotations (T, 3), axis-angle in radians, and shifts (T, 3), in head heights; zero in the first and last frame.

    Sums of six sines between 0.08 and 0.6 Hz, so that nothing is quick; the largest rotation is ``degrees``.
    """
    random, (largest, share) = np.random.default_rng([seed, SWAY]), largest_of(degrees)
    times = np.arange(frames) / frame_rate
    last = float(times[-1]) if frames else 0.0
    # The waves begin anywhere; the ramps bring them from rest and back to it.
    ramp = max(min(AT_REST, last / 3.0), 1e-6)
    rest = smooth_step(times / ramp) * smooth_step((last - times) / ramp)
    rates = random.uniform(*BAND, (6, WAVES))
    phases = random.uniform(0.0, 2.0 * np.pi, (6, WAVES))
    waves = np.sin(2.0 * np.pi * rates * times[:, None, None] + phases).sum(axis=-1) * rest[:, None]

    def scaled(vectors: Array, size: float) -> Array:
        """Vectors (T, 3) of which the longest one is as long as a size."""
        longest = float(np.linalg.norm(vectors, axis=1).max(initial=0.0))
        return share * (vectors * (size / longest) if longest > 0 else vectors)

    return scaled(waves[:, :3] * AXES, np.deg2rad(largest)), scaled(waves[:, 3:], SHIFT * largest)


# Shared by all changes of an animation: arrays that may be too large for memory, and a note in the metadata.


def moves_head(animation: Animation) -> bool:
    """Whether the head of an animation moves as a whole, so that nothing can be added any more."""
    if animation.head is not None:
        return True
    entries = [animation.metadata.get(key, "") for key in (PROCEDURAL, EDITED)]
    return any(word in entry for word in MOVED_HEAD for entry in entries)


def largest_of(amount: Amount) -> tuple[float, float | Array]:
    """The largest of an amount, and the share of it: 1, or one for each frame (T, 1)."""
    if not isinstance(amount, np.ndarray):
        return amount, 1.0
    largest = float(amount.max(initial=0.0)) or 1.0
    return largest, (np.asarray(amount, np.float64) / largest)[:, None]


def in_words(amount: Amount) -> str:
    """An amount in the metadata, such as ``2.5`` or ``1 to 3``."""
    low, high = np.min(amount), np.max(amount)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


def copied(vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A copy to work on, see :func:`allocate_like`."""
    copy = allocate_like(vertices)
    copy[:] = vertices
    return copy


def with_metadata(animation: Animation, vertices: npt.NDArray[np.float32], key: str, note: str) -> Animation:
    """The animation with other vertices (T, V, 3), and words added to an entry of its metadata."""
    before = animation.metadata.get(key)
    entry = note if before is None else f"{before}; {note}"
    return replace(animation, vertices=vertices, metadata={**animation.metadata, key: entry})
