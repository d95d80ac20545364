"""A motion as few shapes and their weights, all within 0 and 1.

Programs that clamp weights (Blender clamps shape keys to 0 … 1) would break the signed weights of principal components,
so that every component becomes two shapes: one for its positive and one for its negative half. Between two frames the
sum of both is linear where the component is, so that nothing is lost there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float32]

BLOCK = 3000
"""Coordinates that are looked at in one go; bounds the memory for residuals."""


@dataclass(frozen=True)
class Morphs:
    """Shapes and weights: frame t is ``rest + Σ weights[t, m] · shapes[m]``.

    Attributes:
        shapes: (M, V, 3) offsets from the rest face.
        weights: (T, M) within 0 and 1.
        components: principal components behind them; None where there is a shape for every frame.
    """

    shapes: Array
    weights: Array
    components: int | None


def compress(offsets: Array, tolerance: float) -> Morphs:
    """As few shapes as keep every vertex of every frame within a distance.

    Principal components of the offsets, not centred, so that the rest face stays where all weights are 0; their number
    is found by bisection of the largest error, which is measured on what will be written, rounded to float32. Where
    that takes no fewer shapes than there are frames, every frame becomes a shape, which is exact.

    Args:
        offsets: (T, V, 3) from the rest face.
        tolerance: largest distance of a vertex, in the unit of the offsets.
    """
    frames, vertices, _ = offsets.shape
    flat = offsets.reshape(frames, -1)
    scores, axes = principal(flat)
    halves = (scores > 0).any(0).astype(int) + (scores < 0).any(0)
    low, high, best = 0, int((halves.cumsum() < frames).sum()) + 1, None
    while high - low > 1:  # low components are not enough; high are, once there is a best
        middle = (low + high) // 2
        made = split(scores[:, :middle], axes[:middle])
        if largest_error(flat, *made) <= tolerance:
            high, best = middle, made
        else:
            low = middle
    if best is None and not flat.any():
        best = split(scores[:, :0], axes[:0])
    if best is None:
        return Morphs(offsets, np.eye(frames, dtype=np.float32), None)
    return Morphs(best[1].reshape(-1, vertices, 3), best[0], high)


def principal(flat: Array) -> tuple[Array, Array]:
    """Scores (T, K) and axes (K, 3V), the strongest first, with their product equal to ``flat`` (T, 3V).

    Through the T × T products between frames, since there are far fewer frames than coordinates. Squaring loses
    components weaker than about 1e-7 of the strongest; whoever needs them sees it in the error.
    """
    gram = np.zeros((len(flat), len(flat)))
    for block in _blocks(flat):
        gram += block @ block.T
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1]
    order = order[values[order] > max(values.max(), 0) * 1e-14]
    scores = vectors[:, order]
    axes = np.concatenate([scores.T @ block for block in _blocks(flat)], axis=1)
    return scores.astype(np.float32), axes.astype(np.float32)


def split(scores: Array, axes: Array) -> tuple[Array, Array]:
    """Weights (T, M) within 0 and 1 and shapes (M, 3V): the halves that occur of every component."""
    weights, shapes = [], []
    for score, axis in zip(scores.T, axes, strict=True):
        for sign in (1, -1):
            half = np.maximum(sign * score, 0)
            peak = half.max(initial=0)
            if peak > 0:
                weights.append(half / peak)
                shapes.append(sign * peak * axis)
    if not weights:  # a face that never leaves its rest still needs something to animate
        return np.zeros((len(scores), 1), np.float32), np.zeros((1, axes.shape[1]), np.float32)
    return np.stack(weights, 1), np.stack(shapes)


def largest_error(flat: Array, weights: Array, shapes: Array) -> float:
    """Largest distance of a vertex between ``flat`` (T, 3V) and what weights and shapes give."""
    worst = 0.0
    for start in range(0, flat.shape[1], BLOCK):
        left = flat[:, start : start + BLOCK] - weights @ shapes[:, start : start + BLOCK]
        worst = max(worst, float(np.square(left).reshape(len(flat), -1, 3).sum(-1).max()))
    return float(np.sqrt(worst))


def normal_shapes(weights: Array, rest: Array, normals: Callable[[int], Array]) -> Array:
    """Offsets of normals (M, V, 3) that come nearest to the true normals over all frames, with the shapes' weights.

    Normals are no linear function of the vertices, so that the normals of the shapes themselves would not add up;
    least squares over the frames are nearest. Weak directions are left out, since they would only fit noise.

    Args:
        weights: (T, M).
        rest: (V, 3) normals of the rest face.
        normals: the normals (V, 3) of a frame.
    """
    inverse = np.linalg.pinv(weights.astype(np.float64), rcond=1e-2).astype(np.float32)
    made = np.zeros((len(inverse), *rest.shape), np.float32)
    step = 16
    for start in range(0, len(weights), step):
        batch = np.stack([normals(index) - rest for index in range(start, min(start + step, len(weights)))])
        made += np.tensordot(inverse[:, start : start + step], batch, axes=1)
    return made


def _blocks(flat: Array) -> Iterator[npt.NDArray[np.float64]]:
    for start in range(0, flat.shape[1], BLOCK):
        yield flat[:, start : start + BLOCK].astype(np.float64)
