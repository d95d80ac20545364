"""What LAM-Audio2Expression's published code does with weights after its network: all of it is optional.

The mouth is damped where there is silence, weights are smoothed by a Savitzky-Golay filter, left and right are
averaged, and eyes blink at random. Random numbers come from NumPy's old generator, so that a seed gives what
``numpy.random.seed`` gives there. Its random movements of the brows are not here: they are captured curves.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from facediff.errors import ArgumentError
from facediff.spaces import Space
from facediff.utils import SAMPLE_RATE

Values = npt.NDArray[np.float32]

STEPS = ("mouth", "smooth", "symmetric", "halves", "blinks")
"""In the order in which they are done."""

SILENCE, DAMPED = 0.001, 0.1
"""Loudness below which a frame is silent, and what its mouth is multiplied by."""

CONTEXT_FRAMES = 64
"""Frames that the published stream computes for each chunk of speech, the chunk's own among them."""

BLINKS = np.array(
    [
        [0.365, 0.950, 0.956, 0.917, 0.367, 0.119, 0.025],
        [0.235, 0.910, 0.945, 0.778, 0.191, 0.235, 0.089],
        [0.870, 0.950, 0.949, 0.696, 0.191, 0.073, 0.007],
        [0.000, 0.557, 0.953, 0.942, 0.426, 0.148, 0.018],
    ]
)
"""The published courses of a lid over seven frames."""


def read_steps(text: str, names: Sequence[str], space: Space) -> frozenset[str]:
    """Steps after a network by their names, joined by ``+``."""
    steps = frozenset(filter(None, text.split("+")))
    if steps - set(names) or (steps and space.kind != "arkit"):
        raise ArgumentError({"finish": text}, f"expected {', '.join(names)}, joined by +, for channels of ARKit alone")
    return steps


@dataclass(frozen=True)
class Postprocessing:
    """Which steps are done, with the channels that they need.

    Attributes:
        steps: some of :data:`STEPS`.
        space: of the weights.
        frame_rate: frames a second.
    """

    steps: frozenset[str]
    space: Space
    frame_rate: float

    @classmethod
    def of(cls, text: str, space: Space, frame_rate: float) -> Postprocessing:
        """Steps by their names, as :func:`read_steps` takes them."""
        return cls(read_steps(text, STEPS, space), space, frame_rate)

    def start(self, seed: int) -> PostprocessedRecording:
        """Process one recording."""
        return PostprocessedRecording(self, np.random.RandomState(seed % 2**32))

    def indices(self, *beginnings: str) -> list[int]:
        """The channels with this prefix."""
        return [index for index, name in enumerate(self.space.channels) if name.startswith(beginnings)]


@dataclass
class PostprocessedRecording:
    """The state of one recording: random numbers, and the last frames of a stream.

    Attributes:
        plan: the steps.
        random: source of the random numbers.
    """

    plan: Postprocessing
    random: np.random.RandomState
    _values: Values = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    _volume: Values = field(default_factory=lambda: np.zeros(0, np.float32))

    def whole(self, values: Values, speech: Values) -> Values:
        """The weights of a recording, all steps."""
        volume = loudness(speech, self.plan.frame_rate)
        steps: dict[str, Callable[[Values], Values]] = {
            "mouth": lambda x: damp_mouth(x, volume, self.mouth),
            "smooth": smooth,
            "symmetric": lambda x: symmetric(x, self.plan.space, sideways=True),
            "halves": lambda x: symmetric(x, self.plan.space, sideways=False),
            "blinks": lambda x: blink(x, self.lids, self.random),
        }
        for name in STEPS:
            if name in self.plan.steps:
                values = steps[name](values.copy())
        return values

    def chunk(self, values: Values, speech: Values) -> Values:
        """The weights of the next chunk of a stream, which continue the chunks before it."""
        if not self.plan.steps:
            return values
        steps, start = self.plan.steps, len(self._values)
        volume = np.concatenate([self._volume, loudness(speech, self.plan.frame_rate)])
        joined = np.concatenate([self._values, values]) if start else values.copy()
        if "mouth" in steps:
            joined = damp_mouth(joined, volume, self.mouth, start)
        if "smooth" in steps:
            joined = smooth(join(joined, start))
        if steps & {"symmetric", "halves"}:
            joined = symmetric(joined, self.plan.space, sideways="symmetric" in steps)
        if "blinks" in steps:
            joined = blink_on(joined, self.lids, self.random, start)
        new = joined[start:]
        # The frames that were given out before are kept as they were, not as the steps have changed them now.
        self._values = np.concatenate([self._values, new])[-CONTEXT_FRAMES:] if start else new.copy()
        self._volume = volume[-CONTEXT_FRAMES:]
        return new

    @property
    def mouth(self) -> list[int]:
        """Channels that silence damps; ``mouthClose`` is not among the published ones."""
        damped = self.plan.indices("mouth", "jaw", "noseSneer", "cheekPuff")
        return [channel for channel in damped if self.plan.space.channels[channel] != "mouthClose"]

    @property
    def lids(self) -> list[int]:
        """Channels of blinks."""
        return self.plan.indices("eyeBlink")


def loudness(speech: Values, frame_rate: float) -> Values:
    """Root mean square of speech around the begin of each frame, over as many samples as a frame has."""
    hop = int(1 / frame_rate * SAMPLE_RATE)
    length = min(hop, len(speech))
    padded = np.pad(speech, length // 2)
    starts = range(0, len(padded) - length + 1, hop)
    rms = [np.sqrt(np.mean(np.square(padded[start : start + length]))) for start in starts]
    return np.array(rms[: math.ceil(len(speech) / SAMPLE_RATE * frame_rate)], np.float32)


def silent_runs(volume: Values, least: int = 7) -> list[npt.NDArray[np.intp]]:
    """Runs of silent frames that are long enough.

    The first run must be a frame longer than the others: the published code counts its steps and not its frames.
    """
    frames = np.flatnonzero(volume < SILENCE)
    runs = np.split(frames, np.flatnonzero(np.diff(frames) != 1) + 1)
    return [run for number, run in enumerate(runs) if len(run) >= least + (number == 0)]


def damp_mouth(values: Values, volume: Values, mouth: list[int], start: int = 0) -> Values:
    """The mouth nearly still in silence, with three frames of transition at either end."""
    for run in silent_runs(volume):
        first, last = int(run[0]), int(run[-1])
        if last >= len(values):
            continue
        values[first : last + 1, mouth] *= np.float32(DAMPED)
        # As published, frames move towards the neighbour less the farther they are from it, in all channels.
        edges = (first - 1, first, 1, min(3, first - start)), (last + 1, last, -1, min(3, len(values) - last - 1))
        for neighbour, edge, step, count in edges:
            if count <= 0:
                continue
            target = values[neighbour].copy()
            for offset in range(count):
                share = (offset + 1) / (count + 1)
                frame = edge + step * offset
                values[frame] = target * (1 - share) + values[frame] * share
    return values


def join(values: Values, start: int) -> Values:
    """Lead the new frames away from the last one that is done, over five frames, or from rest over three."""
    length = min(5 if start else 3, len(values) - start)
    last = values[start - 1].copy() if start else np.zeros_like(values[0])
    for offset in range(length):
        share = (offset + 1) / (length + 1)
        values[start + offset] = last * (1 - share) + values[start + offset] * share
    return values


def smooth(values: Values) -> Values:
    """A parabola through five frames each, mirrored at the ends, clipped to 0 … 1."""
    from scipy.signal import savgol_filter

    if len(values) < 5:  # fewer frames than the filter has
        return values
    smoothed = savgol_filter(values.astype(np.float64), 5, 2, axis=0, mode="mirror")
    return np.clip(smoothed, 0, 1).astype(np.float32)


def symmetric(values: Values, space: Space, *, sideways: bool) -> Values:
    """The mean of left and right in either.

    As published, jaw and mouth are averaged ``sideways`` too, so that they move to both sides and thus to none.
    """
    result = values.copy()
    for left, name in enumerate(space.channels):
        partner = name.removesuffix("Left") + "Right"
        if name.endswith("Left") and partner in space.channels and (sideways or name not in SIDEWAYS):
            pair = [left, space.index(partner)]
            result[:, pair] = ((values[:, pair[0]] + values[:, pair[1]]) / 2)[:, None]
    return result


SIDEWAYS = ("jawLeft", "mouthLeft")
"""What moves to the left, and not the left half."""


def blink(values: Values, lids: list[int], random: np.random.RandomState) -> Values:
    """Blinks in place of the lids' motion: one at the beginning, then one every 67 to 126 frames."""
    values[:, lids] = 0
    start, length = 0, BLINKS.shape[1]
    while start < len(values) - length:
        scale = random.uniform(0.8, 1.0)
        course = BLINKS[random.randint(0, 4)] * scale
        values[start : start + length, lids] = course[:, None]
        start += length + random.randint(60, 120)
    return values


def blink_on(values: Values, lids: list[int], random: np.random.RandomState, start: int) -> Values:
    """At most two blinks in the new frames of a stream, which otherwise keep the lids' motion."""
    length, left = BLINKS.shape[1], len(values) - start
    if left <= length or not lids:
        return values
    closed = np.flatnonzero(values[:start, lids[0]] > 0.5)
    last = int(closed[-1]) - length if len(closed) else start
    # A place among the frames that are done is subtracted from an interval, as published.
    first = max(0, int(random.randint(40, 100)) - last)
    if first > left - length:
        return values
    course = BLINKS[random.randint(0, 4)]
    course = course * random.uniform(0.8, 1.0)
    end = start + first + length
    values[start + first : end, lids] = course[:, None]
    after = len(values) - end
    if after > 40:
        strength, interval = random.uniform(0.8, 1.0), int(random.randint(40, 100))
        if after - length > interval:
            course = BLINKS[random.randint(0, 4)] * strength
            values[end + interval : end + interval + length, lids] = course[:, None]
    return values
