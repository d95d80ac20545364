"""Shapes of a motion that is too long for memory: as near and hardly more than those of one in memory."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from facediff.export.motion_shapes import compress, compress_long, largest_error


def motion(frames: int, rank: int) -> np.ndarray:
    """Offsets (T, 3V) of a few components of falling size, and noise far below the tolerance."""
    random = np.random.default_rng(0)
    scores = random.standard_normal((frames, rank)) * 0.8 ** np.arange(rank)
    axes = random.standard_normal((rank, 90))
    return (scores @ axes + 1e-5 * random.standard_normal((frames, 90))).astype(np.float32)


def test_shapes_are_as_near_as_asked_for() -> None:
    flat = motion(900, 40)

    def parts() -> Iterator[np.ndarray]:
        for first in range(0, len(flat), 70):
            yield flat[first : first + 70]

    found = compress_long(parts, 0.05)
    assert found is not None
    weights, shapes, components = found
    assert weights.min() >= 0
    assert weights.max() <= 1
    assert largest_error(flat, weights, shapes) <= 0.05
    in_memory = compress(flat.reshape(900, 30, 3), 0.05).components
    assert in_memory is not None
    assert in_memory <= components <= in_memory + 2


def test_a_motion_without_movement_has_one_shape_that_is_empty() -> None:
    found = compress_long(lambda: iter([np.zeros((300, 90), np.float32)]), 0.05)
    assert found is not None
    assert not found[1].any()


def test_too_many_components_are_left_to_the_other_way() -> None:
    flat = np.random.default_rng(0).standard_normal((600, 570)).astype(np.float32)
    assert compress_long(lambda: iter([flat]), 1e-4) is None
