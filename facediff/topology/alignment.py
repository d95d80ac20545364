"""Laying one set of points onto another: least squares, and a robust fit that part of the points may disagree with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

Array = npt.NDArray[np.float64]

TUKEY = 4.685
"""Residuals beyond this many scales have no weight (Holland and Welsch, 1977: 95 % efficient for normal residuals)."""
MEDIAN_TO_SCALE = 1.5382
"""Median length of a 3-D normal vector of unit standard deviation (the Maxwell distribution's median)."""
TRIALS = 64
"""Random triples for the robust start: with 42 % outliers, all triples hold one once in ten million times."""
JUDGES = 256
"""Points that judge the trials."""
ITERATIONS = 60
TOLERANCE = 1e-9
DEGENERATE = 1e-12


@dataclass(frozen=True)
class Similarity:
    """x → scale · rotation x + translation.

    Attributes:
        rotation: (3, 3) proper rotation.
        translation: (3,), in the unit of the target.
        scale: target units to a source unit.
    """

    rotation: Array
    translation: Array
    scale: float = 1.0

    def apply(self, points: npt.NDArray[np.floating]) -> Array:
        """Map points (..., 3), in float64."""
        moved: Array = self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation
        return moved

    def inverse(self) -> Similarity:
        """The way back."""
        turned = self.rotation.T
        return Similarity(turned, -(turned @ self.translation) / self.scale, 1.0 / self.scale)

    def then(self, other: Similarity) -> Similarity:
        """This map followed by another one."""
        translation = other.apply(self.translation)
        return Similarity(other.rotation @ self.rotation, translation, other.scale * self.scale)


def align(
    source: npt.NDArray[np.floating],
    target: npt.NDArray[np.floating],
    *,
    weights: npt.NDArray[np.floating] | None = None,
    scale: bool = False,
) -> Similarity:
    """The map from source to target (both (N, 3)) with the least weighted sum of squared distances.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991. The
    rotation is proper even where a reflection would fit better.

    Args:
        source: points to move.
        target: where they should come to lie, in the same order.
        weights: (N,), none negative; all alike if None.
        scale: whether to fit the scale; 1 otherwise.

    Raises:
        FaceDiffError: if shapes differ, a value is not finite, or the points do not determine a rotation: fewer than
            three with weight, all in one place or all on a line.
    """
    source, target, weights = _checked(source, target, weights)
    return _similarity(*_fit(source[None], target, weights[None], scale))


def robust_align(
    source: npt.NDArray[np.floating],
    target: npt.NDArray[np.floating],
    *,
    weights: npt.NDArray[np.floating] | None = None,
    scale: bool = False,
) -> Similarity:
    """The map from source to target that most points agree on; up to some 40 % of them may have moved.

    An MM-estimate: it starts from the triple of points whose fit has the least median residual (Rousseeuw, "Least
    median of squares regression", JASA 1984), since a least-squares start is drawn along by a jaw that moves as one,
    and goes on by iteratively re-weighted least squares with Tukey's biweight, whose scale is the median residual.
    The triples are drawn with a fixed seed: equal input gives equal output.

    Args:
        source: points to move (N, 3).
        target: where they should come to lie (N, 3).
        weights: (N,), none negative, which multiply the robust ones; points of weight 0 are left out. Alike if None.
        scale: whether to fit the scale; 1 otherwise.

    Raises:
        FaceDiffError: as :func:`align`.
    """
    source, target, weights = _checked(source, target, weights)
    return _similarity(*robust_fit(source[None], target, weights, scale=scale))


def robust_fit(
    source: Array, target: Array, weights: Array | None = None, *, scale: bool = False, near: bool = False
) -> tuple[Array, Array, Array]:
    """:func:`robust_align` of many sources (B, N, 3) to one target (N, 3) at a time; inputs are not checked.

    With ``near``, the sources lie on the target but for little, and the search for a start is left out.

    Returns:
        rotations (B, 3, 3), translations (B, 3) and scales (B,).
    """
    base = np.ones(len(target)) if weights is None else weights
    used = base > 0
    if not used.all():
        source, target, base = source[:, used], target[used], base[used]
    size = face_size(target)
    if near:
        rotation, translation, factor = _unmoved(len(source))
    else:
        rotation, translation, factor = _start(source, target, base, scale)
    for _ in range(ITERATIONS):
        before = rotation, translation, factor
        residual = _residuals(source, target, *before)
        spread = np.maximum(np.median(residual, axis=-1, keepdims=True) / MEDIAN_TO_SCALE, DEGENERATE * size)
        robust = np.square(np.clip(1.0 - np.square(residual / (TUKEY * spread)), 0.0, None))
        rotation, translation, factor = _fit(source, target, base * robust, scale)
        moved = max(
            np.abs(rotation - before[0]).max(), np.abs(translation - before[1]).max() / max(size, DEGENERATE)
        )  # the scale cannot change without moving what lies off the origin
        if moved < TOLERANCE:
            break
    return rotation, translation, factor


def face_size(vertices: npt.NDArray[np.floating]) -> float:
    """Size of a set of points (N, 3): their root-mean-square distance from their mean."""
    centred = np.asarray(vertices, np.float64) - np.mean(vertices, axis=0, dtype=np.float64)
    return float(np.sqrt(np.square(centred).sum(axis=-1).mean()))


def _unmoved(count: int) -> tuple[Array, Array, Array]:
    return np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3)), np.ones(count)


def _start(source: Array, target: Array, base: Array, scale: bool) -> tuple[Array, Array, Array]:
    """Least squares, or the fit to a random triple of points where its median residual is less."""
    random = np.random.default_rng(0)
    judges = random.permutation(len(target))[:JUDGES]
    judged, goal = source[:, judges], target[judges]
    best = _fit(source, target, np.broadcast_to(base, source.shape[:2]), scale)
    least = np.median(_residuals(judged, goal, *best), axis=-1)
    alike = np.ones((len(source), 3))
    for triple in random.integers(len(target), size=(TRIALS, 3)):
        trial = _fit(source[:, triple], target[triple], alike, scale, check=False)
        median = np.median(_residuals(judged, goal, *trial), axis=-1)
        better = median < least
        least = np.where(better, median, least)
        best = tuple(
            np.where(better.reshape(-1, *[1] * (new.ndim - 1)), new, old) for new, old in zip(trial, best, strict=True)
        )  # type: ignore[assignment]
    return best


def _fit(
    source: Array, target: Array, weights: Array, scale: bool, *, check: bool = True
) -> tuple[Array, Array, Array]:
    """Weighted least squares of sources (B, N, 3) to a target (N, 3) with weights (B, N)."""
    total = weights.sum(axis=-1, keepdims=True)
    if check and not (total > 0).all():
        raise FaceDiffError("alignment: no point has any weight; expected at least three that are not on a line")
    share = (weights / total)[:, None, :]
    centre, goal = share @ source, share @ target
    away = source - centre
    u, spread, vt = np.linalg.svd(((target - goal) * share.swapaxes(1, 2)).swapaxes(1, 2) @ away)
    if check and (spread[:, 1] <= DEGENERATE * np.maximum(spread[:, 0], np.finfo(float).tiny)).any():
        raise FaceDiffError(
            "alignment: the points do not determine a rotation, since fewer than three of them count, or all lie in "
            "one place or on one line; expected at least three that are not on a line"
        )
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
    """Distances (B, N) that are left."""
    left = source @ (factor[:, None, None] * rotation).swapaxes(1, 2)
    left += translation[:, None]
    left -= target
    return np.sqrt(np.einsum("bni,bni->bn", left, left))


def _similarity(rotation: Array, translation: Array, factor: Array) -> Similarity:
    return Similarity(rotation[0], translation[0], float(factor[0]))


def _checked(
    source: npt.NDArray[np.floating], target: npt.NDArray[np.floating], weights: npt.NDArray[np.floating] | None
) -> tuple[Array, Array, Array]:
    points: Array = np.asarray(source, np.float64)
    goal: Array = np.asarray(target, np.float64)
    if points.shape != goal.shape or points.ndim != 2 or points.shape[-1] != 3:
        raise FaceDiffError(
            f"alignment: source has shape {points.shape} and target {goal.shape}; expected two equal ones (points, 3)"
        )
    used: Array = np.ones(len(points)) if weights is None else np.asarray(weights, np.float64)
    if used.shape != points.shape[:1] or (used < 0).any():
        raise FaceDiffError(
            f"alignment: weights have shape {used.shape} for {len(points)} points; expected one each, none negative"
        )
    if not (np.isfinite(points).all() and np.isfinite(goal).all() and np.isfinite(used).all()):
        raise FaceDiffError("alignment: a point or a weight is NaN or infinite; leave it out")
    if np.count_nonzero(used) < 3:
        raise FaceDiffError("alignment: fewer than three points have weight; expected three that are not on a line")
    return points, goal, used
