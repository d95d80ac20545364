"""Taking the head's rigid motion out of a sequence of faces, for sequences too large to be held in memory twice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.topology.alignment import Array, robust_fit

Indices = npt.NDArray[np.int64]

CHUNK_BYTES = 32 * 2**20
"""Size of the frames that are worked on at a time, as float64; the work needs a few times as much."""
SAMPLE = 64
"""Frames, evenly spread, from which a sequence's median face and its stable vertices are found."""
STILLEST = 0.3
"""Share of the vertices that counts as stable."""
ROUNDS = 10
AGREED = 0.98
"""Share of the stable vertices that two rounds must have in common to end the search."""
ANCHORS = 2000
"""As many vertices, evenly spread over the list, are enough to lay sampled frames onto one another."""


@dataclass(frozen=True)
class RigidMotion:
    """What :func:`remove_rigid_motion` found.

    Attributes:
        frames: (T, V, 3) the frames laid onto the target.
        rotations: (T, 3, 3) from a frame to the target.
        translations: (T, 3); frame t comes to lie at ``frames[t] @ rotations[t].T + translations[t]``.
        residuals: (T,) root-mean-square distance of the stable vertices from the target that is left.
    """

    frames: npt.NDArray[np.floating]
    rotations: Array
    translations: Array
    residuals: Array


def remove_rigid_motion(
    frames: npt.NDArray[np.floating],
    target: npt.NDArray[np.floating],
    stable: Indices | None = None,
    *,
    out: npt.NDArray[np.floating] | None = None,
    chunk_bytes: int = CHUNK_BYTES,
) -> RigidMotion:
    """Lay every frame onto the target by rotation and translation, each by a robust fit of the stable vertices.

    Works chunk by chunk: ``frames`` and ``out`` may be memory-mapped and never lie in memory as a whole.

    Args:
        frames: (T, V, 3) vertices.
        target: (V, 3) the face to lay them onto.
        stable: indices of the vertices that the fit looks at; all if None.
        out: where to write the result, shape (T, V, 3); may be ``frames`` itself. A new array if None.
        chunk_bytes: how much to take into memory at a time.

    Raises:
        FaceDiffError: if shapes differ, a frame holds NaN, or the stable vertices do not determine a rotation.
    """
    if frames.ndim != 3 or frames.shape[1:] != target.shape or frames.shape[-1] != 3:
        raise FaceDiffError(
            f"rigid motion: frames have shape {frames.shape} and the target {target.shape}; "
            f"expected (frames, vertices, 3) and (vertices, 3)"
        )
    if out is None:
        out = np.empty(frames.shape, frames.dtype)
    if out.shape != frames.shape:
        raise FaceDiffError(f"rigid motion: out has shape {out.shape}, expected that of the frames, {frames.shape}")
    every = np.arange(len(target)) if stable is None else np.asarray(stable)
    goal = np.asarray(target, np.float64)[every]
    rotations, translations, residuals = (
        np.empty((len(frames), 3, 3)),
        np.empty((len(frames), 3)),
        np.empty(len(frames)),
    )
    for part, chunk in chunks(frames, chunk_bytes):
        rotation, translation, _ = robust_fit(chunk[:, every], goal)
        chunk = chunk @ rotation.swapaxes(1, 2)
        chunk += translation[:, None]
        out[part] = chunk
        rotations[part], translations[part] = rotation, translation
        residuals[part] = np.sqrt(np.square(chunk[:, every] - goal).sum(axis=-1).mean(axis=-1))
    return RigidMotion(out, rotations, translations, residuals)


def stable_vertices(frames: npt.NDArray[np.floating], *, share: float = STILLEST, sample: int = SAMPLE) -> Indices:
    """The vertices that move least against one another: skull, forehead, bridge of the nose.

    Frames evenly spread over the sequence are laid onto their median by a robust fit of all vertices; the stillest
    ones are taken, the frames laid anew onto their median by these only, and so on until the choice hardly changes.

    Args:
        frames: (T, V, 3) vertices, with or without the head's motion; may be memory-mapped.
        share: how many of the vertices to take, 0 to 1; at least 10 are taken.
        sample: how many frames to look at.

    Returns:
        Sorted vertex indices.

    Raises:
        FaceDiffError: if a frame that was looked at holds NaN, or its vertices do not determine a rotation.
    """
    some = _sample(frames, sample)
    count = min(some.shape[1], max(10, round(share * some.shape[1])))
    stable = np.arange(some.shape[1])
    for _ in range(ROUNDS):
        laid, median = _laid_onto_median(some, stable)
        restlessness = np.square(laid - median).sum(axis=-1).mean(axis=0)
        before, stable = stable, np.sort(np.argsort(restlessness, kind="stable")[:count])
        if len(np.intersect1d(stable, before)) >= AGREED * len(before):
            break
    return stable


def median_face(frames: npt.NDArray[np.floating], stable: Indices | None = None, *, sample: int = SAMPLE) -> Array:
    """The median over frames of every vertex (V, 3), once the head's rigid motion is out; centred at the origin.

    It has the pose of the frame in the middle, and takes the part of a template where there is none.

    Args:
        frames: (T, V, 3) vertices; may be memory-mapped.
        stable: vertices that tell the head's motion; all, by a robust fit, if None.
        sample: how many frames to look at.

    Raises:
        FaceDiffError: as :func:`stable_vertices`.
    """
    some = _sample(frames, sample)
    _, median = _laid_onto_median(some, np.arange(some.shape[1]) if stable is None else np.asarray(stable))
    return median - median.mean(axis=0)


def chunks(frames: npt.NDArray[np.floating], chunk_bytes: int = CHUNK_BYTES) -> Iterator[tuple[slice, Array]]:
    """Consecutive pieces of (T, V, 3) as float64 copies, with where they stand.

    Raises:
        FaceDiffError: naming the frame, if one holds NaN or infinity.
    """
    step = max(1, chunk_bytes // (24 * frames.shape[1]))
    for first in range(0, len(frames), step):
        chunk = np.array(frames[first : first + step], np.float64)
        finite = np.isfinite(chunk).all(axis=(1, 2))
        if not finite.all():
            raise FaceDiffError(_not_finite(first + int(np.argmin(finite))))
        yield slice(first, first + len(chunk)), chunk


def _not_finite(frame: int) -> str:
    return f"frame {frame} (counted from 0) holds NaN or infinity; repair or remove it"


def _sample(frames: npt.NDArray[np.floating], sample: int) -> Array:
    """Evenly spread frames, each moved to the origin."""
    taken = np.unique(np.linspace(0, len(frames) - 1, min(sample, len(frames))).round().astype(int))
    some = np.array(frames[taken], np.float64)
    finite = np.isfinite(some).all(axis=(1, 2))
    if not finite.all():
        raise FaceDiffError(_not_finite(int(taken[np.argmin(finite)])))
    return some - some.mean(axis=1, keepdims=True)


def _laid_onto_median(some: Array, stable: Indices) -> tuple[Array, Array]:
    """Frames (S, V, 3) laid onto the middle one, then twice onto their median; and that median (V, 3)."""
    anchors = stable[np.linspace(0, len(stable) - 1, min(len(stable), ANCHORS)).round().astype(int)]
    median = some[len(some) // 2]
    laid = some
    for near in (False, True, True):
        rotation, translation, _ = robust_fit(laid[:, anchors], median[anchors], near=near)
        laid = laid @ rotation.swapaxes(1, 2) + translation[:, None]
        median = np.median(laid, axis=0)
    return laid, median
