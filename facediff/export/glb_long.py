"""Shapes of a motion that is too long for memory: principal components that are found stretch by stretch.

:func:`facediff.export.glb.compress` finds those of a motion in memory, by products between all frames. An hour has
90 000 frames, whose products alone would take 65 GB.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

import numpy as np
import numpy.typing as npt

from facediff.export.glb import Array, largest_error, split_signs

RANKS = (128, 256, 512)
"""Components that are tried; a motion that needs more is hardly smaller as shapes."""
STRETCH = 256
"""Frames that are taken in together."""
PROBES = 256
"""Frames by which the number of components is first chosen."""

Parts = Callable[[], Iterator[Array]]
"""Gives all offsets from the rest face, (n, 3V) of consecutive frames at a time."""


def compress_long(parts: Parts, tolerance: float) -> tuple[Array, Array, int] | None:
    """Weights (T, M), shapes (M, 3V) and the number of components of a motion; None if it needs too many.

    Args:
        parts: the motion, which is read several times.
        tolerance: largest distance of a vertex.
    """
    for rank in RANKS:
        axes = leading_axes(parts(), rank)
        scores = np.concatenate([part @ axes.T for part in parts()])
        frames = np.unique(np.linspace(0, len(scores) - 1, PROBES).astype(int))
        probes = chosen_frames(parts(), frames)
        low, high = 0, len(axes)
        while high - low > 1:  # as in compress, by some of the frames
            middle = (low + high) // 2
            weights, shapes = split_signs(scores[:, :middle], axes[:middle])
            low, high = (low, middle) if largest_error(probes, weights[frames], shapes) <= tolerance else (middle, high)
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
        wide = rows.astype(np.float64)
        squares, vectors = np.linalg.eigh(wide @ wide.T)
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
            waiting = [joined[size:]]
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
