"""Another sample rate within two milliseconds.

soxr, by which recordings and streams are resampled elsewhere, works in blocks, and holds back up to 60 ms of a stream:
a third of a face's budget for an answer. Here, a sample needs the 32 samples after it and no more.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

Speech = npt.NDArray[np.float32]

ACROSS = 32
"""Zero crossings of the filter on either side: samples of the lower rate that are heard before and after one."""

BETA = 8.0
"""Of Kaiser's window: what lies above the lower rate's half is 80 dB softer."""

PASSED = 0.92
"""The filter's cut-off as a share of the lower rate's half."""


class Resampler:
    """Converts pieces of a stream, by a filter of windowed sines for each phase between the two rates in Hz.

    Attributes:
        delay: seconds of the stream that are held back.
    """

    def __init__(self, source: int, target: int) -> None:
        common = math.gcd(source, target)
        self._up, self._down = target // common, source // common
        self.delay = 0.0
        if source == target:
            return
        wide = max(1.0, source / target)  # source samples for one zero crossing
        self._half = math.ceil(ACROSS * wide)
        self.delay = self._half / source
        # Row p holds the filter for samples that lie p / up of a source sample after one.
        phases = np.arange(self._up)[:, None] / self._up
        away = (np.arange(-self._half + 1, self._half + 1)[None] - phases) / wide
        shape = np.i0(BETA * np.sqrt(np.maximum(0.0, 1 - np.square(away / ACROSS)))) / np.i0(BETA)
        filters = np.sinc(PASSED * away) * shape * (np.abs(away) <= ACROSS)
        self._filters = (filters / filters.sum(1, keepdims=True)).astype(np.float32)
        self._kept = np.zeros(self._half - 1, np.float32)  # source samples that are still needed
        self._next = 0  # the next target sample's place, in source samples times up, from the first kept one it needs

    def __call__(self, samples: Speech, last: bool = False) -> Speech:
        """The samples (m,) that are certain after hearing more, (n,); all that are left with the last piece."""
        if self.delay == 0.0:
            return samples
        tail = np.zeros(self._half, np.float32) if last else np.zeros(0, np.float32)
        self._kept = np.concatenate([self._kept, np.asarray(samples, np.float32), tail])
        taps = 2 * self._half
        fitting = len(self._kept) - taps + 1  # places at which a whole filter lies within what is there
        count = max(0, -(-(fitting * self._up - self._next) // self._down))
        positions = self._next + self._down * np.arange(count)
        if count:
            windows = np.lib.stride_tricks.sliding_window_view(self._kept, taps)[positions // self._up]
            resampled = np.einsum("nt,nt->n", windows, self._filters[positions % self._up])
        else:
            resampled = np.zeros(0, np.float32)
        self._next += self._down * count
        drop = min(len(self._kept), self._next // self._up)
        self._kept, self._next = self._kept[drop:], self._next - drop * self._up
        return np.asarray(resampled, np.float32)
