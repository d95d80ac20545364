"""Windows over speech: how many frames speech has, and how loud it is taken to be."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np
import numpy.typing as npt
import pytest

from facediff.speech.windows import CONVOLUTIONS, QUIETEST, FrameClock, MotionWindow, SpeechWindows, WindowPlan

Motion = npt.NDArray[np.float32]


@pytest.mark.parametrize("rate", [25.0, 30.0, 50.0])
def test_a_frame_clock_rounds_to_the_nearest_frame(rate: float) -> None:
    for samples in range(0, 40_000, 77):
        exact = Fraction(samples) * Fraction(rate) / 16_000
        assert FrameClock(rate).frames(samples) == round(exact)
        assert FrameClock(rate, "up").frames(samples) == -(-exact.numerator // exact.denominator)


@pytest.mark.parametrize("samples", [0, 399, 400, 719, 720, 16_000, 65_920, 100_001])
def test_a_frame_clock_counts_the_steps_of_a_speech_network(samples: int) -> None:
    steps = samples
    for kernel, stride in CONVOLUTIONS:
        steps = len(range(0, steps - kernel + 1, stride))  # as many windows as fit
    assert FrameClock(30.0, "steps").frames(samples) == int(steps / 50 * 30)
    assert FrameClock(25.0, "pairs").frames(samples) == steps // 2
    seconds = int(samples / 16_000 * 25) - 1
    assert FrameClock(25.0, "seconds_or_pairs").frames(samples) == min(seconds, steps // 2)


class Recorder(SpeechWindows[Motion]):
    """Records what each window is standardised by."""

    def __init__(self) -> None:
        super().__init__(WindowPlan().in_frames(25.0), 25.0)
        self.levels: list[tuple[float, float]] = []

    def generate(
        self, window: MotionWindow, speech: npt.NDArray[np.float32], frames: int, mean: float, deviation: float
    ) -> Motion:
        self.levels.append((mean, deviation))
        return np.zeros((1, window.frames - window.fixed, 1), np.float32)

    def joined(self, parts: Sequence[Motion]) -> Motion:
        return np.concatenate([np.zeros((1, 0, 1), np.float32), *parts], axis=1)


@pytest.mark.parametrize("loudness", [1e-5, 1e-3, 0.1])
def test_noise_of_a_quiet_microphone_is_not_amplified_to_speech(loudness: float) -> None:
    stream, rng = Recorder(), np.random.default_rng(0)
    speech = (loudness * rng.standard_normal(16_000 * 12)).astype(np.float32)
    for first in range(0, len(speech), 7001):
        stream.feed(speech[first : first + 7001])
    stream.finish()
    assert stream.frames == 300
    for _, deviation in stream.levels:
        assert deviation == pytest.approx(max(QUIETEST, loudness), rel=0.02)
