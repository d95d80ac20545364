"""Taking the head's motion out of a person's frames, and saying how much of it there was."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.regions import find_region
from facediff.errors import FaceDiffError
from facediff.person.motion import Motion
from facediff.person.scratch import scratch_array
from facediff.topology import face_size, median_face, remove_rigid_motion
from facediff.topology.rigid_motion import Indices, chunks

Array = npt.NDArray[np.float64]

MIN_STABLE = 10
STILL = 1e-6
"""Motion whose fastest frame moves by less than this share of the face's size is none."""


@dataclass(frozen=True)
class Stabilised:
    """Frames without head motion.

    Attributes:
        frames: (T, V, 3), in the pose of ``face``.
        face: (V, 3) their median.
        stable: the vertices that told the head's motion.
        turns: (T,) angle of the head from its mean pose, in radians.
        shifts: (T,) distance of the head from its mean place, in the motion's unit.
        jitter: root-mean-square distance of the stable vertices from ``face``, in the motion's unit.
        speed: (T,) mean step of the vertices from frame to frame, in the motion's unit.
    """

    frames: npt.NDArray[np.floating]
    face: Array
    stable: Indices
    turns: Array
    shifts: Array
    jitter: float
    speed: Array


def read_stable(source: str, n_vertices: int) -> Indices:
    """Stable vertices from a region file.

    Args:
        source: a text file of indices, or ``FLAME_masks.pkl:scalp+forehead``.
        n_vertices: vertices of the topology.

    Raises:
        FaceDiffError: if the file is missing or unfit.
    """
    file = Path(source.partition(".pkl:")[0] + ".pkl" if ".pkl:" in source else source)
    if not file.is_file():
        raise FaceDiffError(f"--stable {file}: no such file; expected vertex indices separated by commas")
    region = find_region(file.parent, [Path(source).name], "stable vertices", n_vertices)
    if region.count < MIN_STABLE:
        raise FaceDiffError(
            f"--stable {file}: names {region.count} vertices; expected at least {MIN_STABLE}, spread over the skull"
        )
    return np.array(region.indices, np.int64)


def stabilise(motion: Motion, face: Array, stable: Indices, scratch: Path) -> Stabilised:
    """Lay every frame onto the median face; parameters without head motion stay as they are.

    Args:
        motion: the frames.
        face: (V, 3) their median, see :func:`facediff.topology.median_face`.
        stable: the vertices that tell the head's motion.
        scratch: a file to make for the frames.

    Raises:
        FaceDiffError: if a frame holds NaN, or if nothing moves.
    """
    count = len(motion.frames)
    if motion.has_head_motion:
        frames = scratch_array(scratch, motion.frames.shape)
        laid = remove_rigid_motion(motion.frames, face, stable, out=frames)
        turns, shifts = _head_motion(laid.rotations, laid.translations, face[stable].mean(axis=0))
        residuals = laid.residuals
    else:
        frames, turns, shifts = motion.frames, np.zeros(count), np.zeros(count)
        residuals = np.array([np.sqrt(np.square(frame[stable] - face[stable]).sum(axis=-1).mean()) for frame in frames])
    speed = _speed(frames)
    if speed.max() < STILL * face_size(face):
        raise FaceDiffError("the motion holds none: every frame is the same face; expected the frames of a video")
    return Stabilised(frames, face, stable, turns, shifts, float(np.sqrt(np.square(residuals).mean())), speed)


def middle_face(motion: Motion, stable: Indices) -> Array:
    """The median face of a motion; of parameters without head motion, in the coordinates that they have."""
    if motion.has_head_motion:
        return median_face(motion.frames, stable)
    return np.median(motion.frames[:: max(1, len(motion.frames) // 64)], axis=0).astype(np.float64)


def _head_motion(rotations: Array, translations: Array, centre: Array) -> tuple[Array, Array]:
    """Angles from the mean pose, and distances from the mean place, of the head.

    The mean pose is the rotation nearest to the mean of the matrices (the chordal mean).
    """
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    # |R - M|² = 8 sin²(angle / 2): exact for small angles too, where the arc cosine of the trace is not.
    chord = np.sqrt(np.square(rotations - mean).sum(axis=(1, 2)))
    places = np.einsum("tji,tj->ti", rotations, centre - translations)
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0)), np.linalg.norm(places - places.mean(0), axis=1)


def _speed(frames: npt.NDArray[np.floating]) -> Array:
    """Mean of the steps to the frame before and after, (T,).

    The mean length over vertices: a few that jitter count for less than in a root mean square.
    """
    steps = np.zeros(len(frames) + 1)
    last: Array | None = None
    for part, chunk in chunks(frames):
        joined = chunk if last is None else np.concatenate([last[None], chunk])
        moved = np.sqrt(np.square(np.diff(joined, axis=0)).sum(axis=-1)).mean(axis=-1)
        steps[part.stop - len(moved) : part.stop] = moved
        last = chunk[-1]
    if len(frames) > 1:
        steps[0], steps[-1] = steps[1], steps[-2]
    return (steps[:-1] + steps[1:]) / 2
