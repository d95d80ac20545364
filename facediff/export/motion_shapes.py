"""Shapes and weights of a motion: as few principal components as keep every vertex within a distance.

From top to bottom: a motion in memory (:func:`compress`), by products between all of its frames; and one that is too
long for memory (:func:`compress_long`), stretch by stretch: the products of an hour's frames would take 65 GB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

BLOCK = 3000  # Coordinates that are processed together; bounds the memory for residuals
RANKS = (128, 256, 512)
"""Components that are tried; a motion that needs more is hardly smaller as shapes."""
STRETCH = 256
"""Frames that are taken in together."""
PROBES = 256
"""Frames by which the number of components is first chosen."""

Parts = Callable[[], Iterator[Array]]
"""Gives all offsets from the rest face, (n, 3V) of consecutive frames at a time."""


@dataclass(frozen=True)
class Morphs:
    """A motion as shapes and their weights: frame t is ``rest + Σ weights[t, m] · shapes[m]``."""

    shapes: Array  # (M, V, 3) offsets from the rest face
    weights: Array  # (K, M) at the keys; from 0 to 1, but for a motion's own
    components: int | None  # number of principal components that were kept; None where there is a shape for every frame
    names: tuple[str, ...] = ()  # M names; numbers if there are none
    keys: npt.NDArray[np.int64] | None = None  # (K,) frames that have a key; all T if None


def compress(offsets: Array, tolerance: float) -> Morphs:
    """Find as few shapes as keep every vertex of every frame within a distance of the original.

    The shapes are principal components of the offsets, which are not centred, so that the rest face has only weights of
    0. If they are no fewer than the frames, every frame becomes a shape, which is exact.

    Args:
        offsets: (T, V, 3) from the rest face.
        tolerance: largest distance of a vertex, in the unit of the offsets.
    """
    frames, vertices, _ = offsets.shape
    flat = offsets.reshape(frames, -1)
    scores, axes = principal_components(flat)
    halves = (scores > 0).any(0).astype(int) + (scores < 0).any(0)
    # The error shrinks with the number of components, so that bisection finds the smallest number that is enough: low
    # is not enough, high is (once there is a best). It is measured on the numbers that are written, in float32.
    low, high, best = 0, int((halves.cumsum() < frames).sum()) + 1, None
    while high - low > 1:
        middle = (low + high) // 2
        candidate = split_signs(scores[:, :middle], axes[:middle])
        if largest_error(flat, *candidate) <= tolerance:
            high, best = middle, candidate
        else:
            low = middle
    if best is None and not flat.any():
        best = split_signs(scores[:, :0], axes[:0])
    if best is None:
        return Morphs(offsets, np.eye(frames, dtype=np.float32), None)
    return Morphs(best[1].reshape(-1, vertices, 3), best[0], high)


def principal_components(flat: Array) -> tuple[Array, Array]:
    """Scores (T, K) and axes (K, 3V), the strongest first; their product is ``flat`` (T, 3V)."""
    # The eigenvectors of the T × T products between frames give the same scores as a singular value decomposition, and
    # are far cheaper, since there are fewer frames than coordinates. Squaring loses components weaker than about 1e-7
    # of the strongest; the bisection in compress notices if one of them would have been needed.
    gram = np.zeros((len(flat), len(flat)))
    for block in _blocks(flat):
        gram += block @ block.T
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1]
    order = order[values[order] > max(values.max(), 0) * 1e-14]
    scores = vectors[:, order]
    axes = np.concatenate([scores.T @ block for block in _blocks(flat)], axis=1)
    return scores.astype(np.float32), axes.astype(np.float32)


def split_signs(scores: Array, axes: Array) -> tuple[Array, Array]:
    """Weights (T, M) from 0 to 1 and shapes (M, 3V): the positive and the negative half of every component."""
    # Programs that clamp weights (Blender clamps shape keys to 0 … 1) would break the signed weights of principal
    # components. Between two frames the sum of both halves is as linear as the component, so that nothing is lost.
    peaks = [(k, sign, (sign * column).max(initial=0)) for k, column in enumerate(scores.T) for sign in (1, -1)]
    peaks = [(k, sign, peak) for k, sign, peak in peaks if peak > 0]
    if not peaks:  # a face that never moves still needs something to animate
        return np.zeros((len(scores), 1), np.float32), np.zeros((1, axes.shape[1]), np.float32)
    weights = np.empty((len(scores), len(peaks)), scores.dtype)  # once: of an hour they take 100 MB
    for half, (k, sign, peak) in zip(weights.T, peaks, strict=True):
        np.divide(np.maximum(sign * scores[:, k], 0), peak, out=half)
    return weights, np.stack([sign * peak * axes[k] for k, sign, peak in peaks])


def largest_error(flat: Array, weights: Array, shapes: Array) -> float:
    """Largest distance of a vertex between ``flat`` (T, 3V) and the motion of weights and shapes."""
    worst = 0.0
    for start in range(0, flat.shape[1], BLOCK):
        left = flat[:, start : start + BLOCK] - weights @ shapes[:, start : start + BLOCK]
        worst = max(worst, float(np.square(left).reshape(len(flat), -1, 3).sum(-1).max()))
    return float(np.sqrt(worst))


def _blocks(flat: Array) -> Iterator[npt.NDArray[np.float64]]:
    for start in range(0, flat.shape[1], BLOCK):
        yield flat[:, start : start + BLOCK].astype(np.float64)


def compress_long(parts: Parts, tolerance: float) -> tuple[Array, Array, int] | None:
    """Weights (T, M), shapes (M, 3V) and the number of components of a motion; None if it needs too many."""
    for rank in RANKS:
        axes = leading_axes(parts(), rank)
        scores = np.concatenate([part @ axes.T for part in parts()])
        frames = np.unique(np.linspace(0, len(scores) - 1, PROBES).astype(int))
        probes = chosen_frames(parts(), frames)
        low, high = 0, len(axes)
        while high - low > 1:  # as in compress, by some of the frames
            middle = (low + high) // 2
            enough = largest_error(probes, *split_signs(scores[frames, :middle], axes[:middle])) <= tolerance
            low, high = (low, middle) if enough else (middle, high)
        while True:  # and all of them have the last word
            weights, shapes = split_signs(scores[:, :high], axes[:high])
            if within(parts(), weights, shapes, tolerance):
                return weights, shapes, high
            if high == len(axes):
                break
            high = min(len(axes), high + max(1, high // 16))
    return None


def leading_axes(parts: Iterable[Array], rank: int) -> Array:
    """Orthonormal axes (K, 3V) of the most motion, the strongest first; K is ``rank`` at most.

    Those of all frames so far, as long as their motion along them, stand for these frames when more are taken in
    (incremental singular value decomposition: Brand, "Incremental singular value decomposition of uncertain data with
    missing values", ECCV 2002).
    """
    lengths, axes = np.zeros(0), None
    for block in in_blocks(parts, STRETCH):
        rows = block if axes is None else np.concatenate([lengths[:, None].astype(np.float32) * axes, block])
        squares, vectors = np.linalg.eigh(sum(columns @ columns.T for columns in _blocks(rows)))
        order = np.argsort(squares)[::-1][:rank]
        order = order[squares[order] > max(squares.max(), 0) * 1e-10]
        lengths = np.sqrt(squares[order])
        axes = ((vectors[:, order] / lengths).T.astype(np.float32)) @ rows
    assert axes is not None  # noqa: S101 - a motion has frames
    return axes


def in_blocks(parts: Iterable[Array], size: int) -> Iterator[Array]:
    """The same frames in blocks of one size, but for the last."""
    waiting: list[Array] = []
    for part in parts:
        waiting.append(part)
        while sum(map(len, waiting)) >= size:
            joined = np.concatenate(waiting)
            yield joined[:size]
            waiting = [joined[size:].copy()]  # which does not keep the rest in memory
    if sum(map(len, waiting)):
        yield np.concatenate(waiting)


def chosen_frames(parts: Iterable[Array], frames: npt.NDArray[np.integer]) -> Array:
    """Some of the frames, by their numbers in rising order."""
    start, rows = 0, []
    for part in parts:
        here = frames[(frames >= start) & (frames < start + len(part))] - start
        rows.append(part[here])
        start += len(part)
    return np.concatenate(rows)


def within(parts: Iterable[Array], weights: Array, shapes: Array, tolerance: float) -> bool:
    """Whether no vertex of any frame is further from its place than a distance."""
    start = 0
    for part in parts:
        if largest_error(part, weights[start : start + len(part)], shapes) > tolerance:
            return False
        start += len(part)
    return True
