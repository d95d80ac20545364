"""Raw samples through pipes."""

from __future__ import annotations

import io
from unittest.mock import Mock

import numpy as np

from facediff.speech.pcm import pcm


def test_samples_are_whole_however_a_pipe_cuts_them() -> None:
    """Half a sample waits for its other byte; one at the end is dropped."""
    samples = np.random.default_rng(0).integers(-32_768, 32_767, 1000).astype("<i2")
    stream, sizes = io.BytesIO(samples.tobytes() + b"\x07"), iter([1, 1, 3, 640, 7, 2] * 9)
    pieces = pcm(Mock(), 16_000, lambda _, most: stream.read(min(most, next(sizes))))
    np.testing.assert_array_equal(np.concatenate([*pieces]), samples / np.float32(32_768))
