"""How many frames of motion a model gives for speech: its own rule, stated so that it can be exported."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from facediff.utils import SAMPLE_RATE

Rule = Literal["rounded", "steps", "pairs", "seconds", "seconds_or_pairs", "rows", "up"]

STEP_RATE = 50.0
"""Steps a second of pretrained speech networks."""

CONVOLUTIONS = ((10, 5), (3, 2), (3, 2), (3, 2), (3, 2), (2, 2), (2, 2))
"""Kernels and strides of the convolutions of wav2vec 2.0 and HuBERT."""


@dataclass(frozen=True)
class FrameClock:
    """Frames for speech of so many samples at 16 kHz.

    The published methods count by the steps of a pretrained speech network, each in its own order of operations; a
    frame more or less moves all others.

    Attributes:
        frame_rate: motion frames a second.
        rule: ``rounded``: as many as fit the speech, which is then cut or filled up to whole frames. With all others
            the model takes every sample: ``steps``: by the network's steps; ``pairs``: two steps a frame; ``seconds``:
            a frame less than the speech lasts; ``seconds_or_pairs``: the smaller of the two; ``rows``: one of every so
            many rows of a finer clock, from the first on; ``up``: a frame for every part of one.
        convolutions: kernel and stride of each convolution of the speech network.
        rows: rows a frame of the finer clock.

    Example:
        >>> FrameClock(25.0).frames(16_000), FrameClock(25.0, "pairs").frames(16_000)
        (25, 24)
    """

    frame_rate: float
    rule: Rule = "rounded"
    convolutions: tuple[tuple[int, int], ...] = CONVOLUTIONS
    rows: int = 1

    def frames(self, samples: int) -> int:
        """Frames that the model gives; 0 or less if the speech is too short for one."""
        # In these very orders and in floating point, as the projects compute them: 205 steps at 30 frames a second give
        # 122 frames, not 123, and half a row is rounded to an even number.
        pairs = convolved(samples, self.convolutions) // 2
        seconds = int(samples / SAMPLE_RATE * self.frame_rate) - 1
        match self.rule:
            case "rounded":
                return round(samples * self.frame_rate / SAMPLE_RATE)
            case "steps":
                return int((convolved(samples, self.convolutions) / STEP_RATE) * self.frame_rate)
            case "pairs":
                return pairs
            case "seconds":
                return seconds
            case "seconds_or_pairs":
                return min(seconds, pairs)
            case "rows":
                return -(-self.row_count(samples) // self.rows)
            case "up":
                return math.ceil(samples / SAMPLE_RATE * self.frame_rate)

    def row_count(self, samples: int) -> int:
        """Rows of the finer clock."""
        return round(samples / SAMPLE_RATE * (self.frame_rate * self.rows))


def convolved(samples: int, layers: Iterable[tuple[int, int]]) -> int:
    """Steps that convolutions without padding, each of a kernel and a stride, make of so many samples; at least 0.

    >>> convolved(16_000, CONVOLUTIONS)
    49
    """
    for kernel, stride in layers:
        samples = max(0, (samples - kernel) // stride + 1)
    return samples
