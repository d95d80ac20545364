"""Alignment of one set of points with another: by least squares, robustly, and frame by frame over a sequence."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from facediff.errors import FaceDiffError
from facediff.utils.numerics import Array, Floats, Indices, Integers

TUKEY = 4.685
"""Residuals beyond this many scales have no weight (Holland and Welsch, 1977: 95 % efficient for normal residuals)."""
MEDIAN_TO_SCALE = 1.5382
"""Median length of a 3-D normal vector of unit standard deviation (the Maxwell distribution's median)."""
TRIALS = 64
"""Random triples for the robust start: with 42 % outliers, every triple holds one only once in ten million times."""
JUDGES = 256  # Points by which the triples' fits are compared
ITERATIONS = 60
TOLERANCE = 1e-9
DEGENERATE = 1e-12


@dataclass(frozen=True)
class Similarity:
    """x → scale · rotation x + translation."""

    rotation: Array  # (3, 3) proper
    translation: Array  # (3,), in the unit of the target
    scale: float = 1.0  # target units to a source unit

    def apply(self, points: Floats) -> Array:
        """Map points (..., 3), in float64."""
        return np.asarray(self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation)

    def inverse(self) -> Similarity:
        """The map from the target to the source."""
        return Similarity(self.rotation.T, -(self.rotation.T @ self.translation) / self.scale, 1.0 / self.scale)

    def then(self, following: Similarity) -> Similarity:
        """This map followed by another one."""
        translation = following.apply(self.translation)
        return Similarity(following.rotation @ self.rotation, translation, following.scale * self.scale)


def align(source: Floats, target: Floats, *, weights: Floats | None = None, scale: bool = False) -> Similarity:
    """The map from source to target (both (N, 3)) with the least weighted sum of squared distances.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. The
    rotation is proper even where a reflection would fit better.

    Args:
        source: points to move.
        target: where they should come to lie, in the same order.
        weights: (N,), none negative; all alike if None.
        scale: whether to fit the scale; 1 otherwise.

    Example:
        >>> points = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0.0]])
        >>> found = align(points, 3 * points + 1, scale=True)
        >>> round(found.scale, 6), found.translation.round(6)
        (3.0, array([1., 1., 1.]))
    """
    points: Array = np.asarray(source, np.float64)
    base: Array = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    rotation, translation, factor = fit_similarities(points[None], np.asarray(target, np.float64), base[None], scale)
    return Similarity(rotation[0], translation[0], float(factor[0]))


def robust_align(source: Floats, target: Floats, *, weights: Floats | None = None, scale: bool = False) -> Similarity:
    """The map from source to target that most points agree on; up to some 40 % of them may have moved.

    An MM-estimate: it starts from the triple of points with the least median residual (Rousseeuw, "Least median of
    squares regression", JASA 1984), since a least-squares start follows a jaw that moves as one, and continues by
    iteratively re-weighted least squares with Tukey's biweight, scaled by the median residual. The
    triples have a fixed seed: equal input gives equal output.

    Arguments as in :func:`align`; weights multiply the robust ones, and points of weight 0 are ignored.
    """
    points, goal = np.asarray(source, np.float64), np.asarray(target, np.float64)
    base = None if weights is None else np.asarray(weights, np.float64)
    rotation, translation, factor = robust_fit(points[None], goal, base, scale=scale)
    return Similarity(rotation[0], translation[0], float(factor[0]))


def robust_fit(
    source: Array, target: Array, weights: Array | None = None, *, scale: bool = False, near: bool = False
) -> tuple[Array, Array, Array]:
    """Rotations (B, 3, 3), translations (B, 3), scales (B,): :func:`robust_align` of sources (B, N, 3) to one target.

    Inputs are not checked. With ``near``, the sources are nearly aligned already: the search for a start is skipped.
    """
    base = np.ones(len(target)) if weights is None else weights
    weighted = base > 0
    if not weighted.all():
        source, target, base = source[:, weighted], target[weighted], base[weighted]
    # The scale of the residuals has a floor, relative to the target's size, so that an exact fit divides by no zero.
    size = face_size(target)
    if near:
        count = len(source)
        rotation, translation, factor = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.ones(count)
    else:
        rotation, translation, factor = _start(source, target, base, scale)
    for _ in range(ITERATIONS):
        before = rotation, translation, factor
        residual = _residuals(source, target, *before)
        spread = np.maximum(np.median(residual, axis=-1, keepdims=True) / MEDIAN_TO_SCALE, DEGENERATE * size)
        # Tukey's biweight, (1 − (r / cσ)²)²: points beyond c standard deviations lose all influence.
        robust = np.square(np.clip(1.0 - np.square(residual / (TUKEY * spread)), 0.0, None))
        rotation, translation, factor = fit_similarities(source, target, base * robust, scale)
        # The scale is not compared: where points lie off the origin, it cannot change without the translation.
        shift = np.abs(translation - before[1]).max() / max(size, DEGENERATE)
        if max(np.abs(rotation - before[0]).max(), shift) < TOLERANCE:
            break
    return rotation, translation, factor


def face_size(vertices: Floats) -> float:
    """Size of a set of points (N, 3): their root-mean-square distance from their mean."""
    centred = np.asarray(vertices, np.float64) - np.mean(vertices, axis=0, dtype=np.float64)
    return float(np.sqrt(np.square(centred).sum(axis=-1).mean()))


def _start(source: Array, target: Array, base: Array, scale: bool) -> tuple[Array, Array, Array]:
    """Least squares, or the fit to a random triple of points where its median residual is less."""
    # A triple without outliers fits all points that did not move; its median residual is then small. Some hundred
    # points are enough to compare medians, so that many frames are cheap.
    random = np.random.default_rng(0)  # equal meshes are aligned by the same bits in every run and on every worker
    judges = random.permutation(len(target))[:JUDGES]
    judged, goal = source[:, judges], target[judges]
    best = fit_similarities(source, target, np.broadcast_to(base, source.shape[:2]), scale)
    least = np.median(_residuals(judged, goal, *best), axis=-1)
    # Three points determine a rotation without a remainder: weights would change nothing.
    alike = np.ones((len(source), 3))
    for triple in random.integers(len(target), size=(TRIALS, 3)):
        trial = fit_similarities(source[:, triple], target[triple], alike, scale, check=False)
        median = np.median(_residuals(judged, goal, *trial), axis=-1)
        better = median < least
        least = np.where(better, median, least)
        best = tuple(
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in zip(trial, best, strict=True)
        )  # type: ignore[assignment]
    return best


def fit_similarities(
    source: Array, target: Array, weights: Array, scale: bool, *, check: bool = True
) -> tuple[Array, Array, Array]:
    """Rotations (B, 3, 3), translations (B, 3), scales (B,) of sources (B, N, 3) to a target (N, 3), weights (B, N)."""
    total = weights.sum(axis=-1, keepdims=True)
    share = (weights / total)[:, None, :]
    centre, goal = share @ source, share @ target
    # The target need not be centred as well: the source's offsets sum to zero by weight.
    away = source - centre
    u, spread, vt = np.linalg.svd(((target - goal) * share.swapaxes(1, 2)).swapaxes(1, 2) @ away)
    if check and (spread[:, 1] <= DEGENERATE * np.maximum(spread[:, 0], np.finfo(float).tiny)).any():
        raise FaceDiffError(
            "alignment: the points do not determine a rotation, since fewer than three of them count, or all lie in "
            "one place or on one line; expected at least three that are not on a line"
        )
    # Where the best orthogonal matrix is a reflection, the axis with the least spread is turned round.
    proper = np.where(np.linalg.det(u @ vt) < 0, -1.0, 1.0)
    u[:, :, 2] *= proper[:, None]
    rotation = u @ vt
    factor = np.ones(len(source))
    if scale:
        variance = (share @ np.square(away)).sum(axis=(1, 2))
        factor = (spread[:, 0] + spread[:, 1] + proper * spread[:, 2]) / np.maximum(variance, np.finfo(float).tiny)
    translation = (goal - factor[:, None, None] * (centre @ rotation.swapaxes(1, 2)))[:, 0]
    return rotation, translation, factor


def _residuals(source: Array, target: Array, rotation: Array, translation: Array, factor: Array) -> Array:
    """Distances (B, N) between moved points and their targets."""
    left = source @ (factor[:, None, None] * rotation).swapaxes(1, 2)
    left += translation[:, None]
    left -= target
    return np.sqrt(np.einsum("bni,bni->bn", left, left))


# Removing the head's rigid motion from a sequence of faces that may be too large to be held in memory twice.

CHUNK_BYTES = 32 * 2**20
"""Size of the frames that are processed at a time, as float64; processing needs a few times as much."""
SAMPLE = 64  # Frames, evenly spread, from which a sequence's median face and its stable vertices are found
STILLEST = 0.3  # Share of the vertices that counts as stable
ROUNDS = 10
AGREED = 0.98  # Share of the stable vertices that two rounds must have in common to end the search
ANCHORS = 2000  # As many vertices, evenly spread over the list, are enough to align sampled frames with one another


@dataclass(frozen=True)
class RigidMotion:
    """Result of :func:`remove_rigid_motion`."""

    frames: Floats  # (T, V, 3) aligned with the target
    rotations: Array  # (T, 3, 3) from a frame to the target
    translations: Array  # (T, 3); frame t is moved to ``frames[t] @ rotations[t].T + translations[t]``
    residuals: Array  # (T,) root-mean-square distance of the stable vertices from the target that is left


def remove_rigid_motion(
    frames: Floats,
    target: Floats,
    stable: Indices | None = None,
    *,
    out: Floats | None = None,
    chunk_bytes: int = CHUNK_BYTES,
) -> RigidMotion:
    """Align every frame with the target by rotation and translation, each by a robust fit of the stable vertices.

    Works chunk by chunk: ``frames`` and ``out`` may be memory-mapped and are never in memory as a whole.

    Args:
        frames: (T, V, 3) vertices.
        target: (V, 3) the face to align them with.
        stable: indices of the vertices that the fit uses; all if None.
        out: where to write the result, floating point (T, V, 3); may be ``frames`` itself. A new array if None.
        chunk_bytes: how much to read into memory at a time.
    """
    if out is None:
        out = np.empty(frames.shape, frames.dtype if frames.dtype.kind == "f" else np.float64)
    every = np.arange(len(target)) if stable is None else np.asarray(stable)
    goal = np.asarray(target, np.float64)[every]
    count = len(frames)
    rotations, translations, residuals = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty(count)
    for part, chunk in chunks(frames, chunk_bytes):
        rotation, translation, _ = robust_fit(chunk[:, every], goal)
        chunk = chunk @ rotation.swapaxes(1, 2)
        chunk += translation[:, None]
        out[part] = chunk
        rotations[part], translations[part] = rotation, translation
        # Over the vertices of the fit only: the motion of a speaking mouth says nothing about the alignment.
        residuals[part] = np.sqrt(np.square(chunk[:, every] - goal).sum(axis=-1).mean(axis=-1))
    return RigidMotion(out, rotations, translations, residuals)


def stable_vertices(frames: Floats, *, share: float = STILLEST, sample: int = SAMPLE) -> Indices:
    """The vertices that move least against one another: skull, forehead, bridge of the nose.

    Frames evenly spread over the sequence are aligned with their median by a robust fit of all vertices; the stillest
    vertices are chosen, the frames are aligned again by these only, and so on until the choice hardly changes.

    Args:
        frames: (T, V, 3) vertices, with or without the head's motion; may be memory-mapped.
        share: how many of the vertices to choose, 0 to 1; at least 10 are chosen.
        sample: how many frames to use.

    Returns:
        Sorted vertex indices.
    """
    some = _sample(frames, sample)
    # A handful at least: with fewer vertices a single noisy one would turn the whole head.
    count = min(some.shape[1], max(10, round(share * some.shape[1])))
    stable = np.arange(some.shape[1])
    for _ in range(ROUNDS):
        aligned, median = _aligned_with_median(some, stable)
        restlessness = np.square(aligned - median).sum(axis=-1).mean(axis=0)
        # The choice and the alignment depend on each other: once the jaw no longer takes part in the alignment, the
        # vertices at rest stand out more clearly.
        before, stable = stable, np.sort(np.argsort(restlessness, kind="stable")[:count])
        if len(np.intersect1d(stable, before)) >= AGREED * len(before):
            break
    return stable


def median_face(frames: Floats, stable: Indices | None = None, *, sample: int = SAMPLE) -> Array:
    """The median over frames of every vertex (V, 3), without the head's rigid motion; centred at the origin.

    It has the pose of the frame in the middle, and serves as a template where there is none.

    Args:
        frames: (T, V, 3) vertices; may be memory-mapped.
        stable: vertices that determine the head's motion; all, by a robust fit, if None.
        sample: how many frames to use.
    """
    some = _sample(frames, sample)
    _, median = _aligned_with_median(some, np.arange(some.shape[1]) if stable is None else np.asarray(stable))
    return median - median.mean(axis=0)


def chunks(frames: Floats, chunk_bytes: int = CHUNK_BYTES) -> Iterator[tuple[slice, Array]]:
    """Consecutive pieces of (T, V, 3) as float64 copies, each with its slice of frames; a frame with NaN is refused."""
    step = max(1, chunk_bytes // (24 * frames.shape[1]))
    for first in range(0, len(frames), step):
        chunk = np.array(frames[first : first + step], np.float64)
        _refuse_not_finite(chunk, np.arange(first, first + len(chunk)))
        yield slice(first, first + len(chunk)), chunk


def _refuse_not_finite(frames: Array, numbers: Integers) -> None:
    finite = np.isfinite(frames).all(axis=(1, 2))
    if not finite.all():
        frame = int(numbers[np.argmin(finite)])
        raise FaceDiffError(f"frame {frame} (counted from 0) holds NaN or infinity; repair or remove it")


def _sample(frames: Floats, sample: int) -> Array:
    """Evenly spread frames, each moved to the origin."""
    numbers = np.unique(np.linspace(0, len(frames) - 1, min(sample, len(frames))).round().astype(int))
    some = np.array(frames[numbers], np.float64)
    _refuse_not_finite(some, numbers)
    return some - some.mean(axis=1, keepdims=True)


def _aligned_with_median(some: Array, stable: Indices) -> tuple[Array, Array]:
    """Frames (S, V, 3) aligned with the middle one, then twice with their median; and that median (V, 3)."""
    # Vertices are spread over the list, not drawn at random: neighbours have neighbouring numbers in most meshes.
    anchors = stable[np.linspace(0, len(stable) - 1, min(len(stable), ANCHORS)).round().astype(int)]
    median = some[len(some) // 2]
    aligned = some
    # The middle frame may be an extreme one; the median of aligned frames is not, and two rounds settle it.
    for near in (False, True, True):
        rotation, translation, _ = robust_fit(aligned[:, anchors], median[anchors], near=near)
        aligned = aligned @ rotation.swapaxes(1, 2) + translation[:, None]
        median = np.median(aligned, axis=0)
    return aligned, median
