"""Speech over time: the frames that a model gives for it, sliding windows over long speech, and the loop over them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Generic, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.speech.audio import samples_for
from facediff.utils import SAMPLE_RATE

Speech = npt.NDArray[np.float32]
"""Samples at 16 kHz, mono, (S,)."""

M = TypeVar("M")
"""Motion of one or several samples: an array or a tensor (seeds, frames, …)."""

QUIETEST = 0.003
"""Standard deviation below which speech is not amplified further: noise of a microphone, not speech."""

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
        rule: ``rounded``: as many as fit the speech, which is then cut or filled up to whole frames. With all others
            the model takes every sample: ``steps``: by the network's steps; ``pairs``: two steps a frame; ``seconds``:
            a frame less than the speech lasts; ``seconds_or_pairs``: the smaller of the two; ``rows``: one of every so
            many rows of a finer clock, from the first on; ``up``: a frame for every part of one.
        convolutions: kernel and stride of each convolution of the speech network.
        rows: rows a frame of the finer clock.
    """

    frame_rate: float
    rule: Rule = "rounded"
    convolutions: tuple[tuple[int, int], ...] = CONVOLUTIONS
    rows: int = 1

    def frames(self, samples: int) -> int:
        """Frames that the model gives; 0 or less if the speech is too short for one."""
        # In these very orders and in floating point, as the projects compute them: 205 steps at 30 frames a second give
        # 122 frames, not 123, and half a row is rounded to an even number.
        steps = convolved(samples, self.convolutions)
        seconds = int(samples / SAMPLE_RATE * self.frame_rate) - 1
        return {
            "rounded": round(samples * self.frame_rate / SAMPLE_RATE),
            "steps": int((steps / STEP_RATE) * self.frame_rate),
            "pairs": steps // 2,
            "seconds": seconds,
            "seconds_or_pairs": min(seconds, steps // 2),
            "rows": -(-self.row_count(samples) // self.rows),
            "up": math.ceil(samples / SAMPLE_RATE * self.frame_rate),
        }[self.rule]

    def row_count(self, samples: int) -> int:
        """Rows of the finer clock."""
        return round(samples / SAMPLE_RATE * (self.frame_rate * self.rows))


def convolved(samples: int, layers: Iterable[tuple[int, int]]) -> int:
    """Steps that convolutions without padding, each of a kernel and a stride, make of so many samples; at least 0."""
    for kernel, stride in layers:
        samples = max(0, (samples - kernel) // stride + 1)
    return samples


@dataclass(frozen=True)
class WindowPlan:
    """How long speech is cut into windows; lengths in seconds.

    Models of this field learn from sentences of three to five seconds, and are at their best with windows of that
    length. With a ``past``, windows may be as short as a frame or two: :data:`LOW_LATENCY`.

    Attributes:
        seconds: length of a window's motion.
        overlap: how much of it the next one shares; at most half of it, with a ``past`` less than all of it.
        before, after: speech around the window that the model receives too.
        above: speech that lasts longer is animated by windows, other speech in one pass.
        past: motion before the window, given out already, that it sees and continues.
        ahead: motion after the window that is generated with it and not given out. Its noise is known before its
            speech; where that is not heard yet, the speech is taken to stay as it was last.

    Example:
        >>> plan = WindowPlan(seconds=2.0, overlap=0.5)
        >>> plan.in_frames(25.0)
        FramePlan(frames=50, overlap=12, before=50, after=12, past=0, ahead=0)
        >>> plan.look_ahead
        2.5
    """

    seconds: float = 4.0
    overlap: float = 1.0
    before: float = 2.0
    after: float = 0.5
    above: float = 10.0
    past: float = 0.0
    ahead: float = 0.0

    def __post_init__(self) -> None:
        # A window that sees motion which does not change any more need not share frames that do.
        fits = 0 <= self.overlap < self.seconds if self.past else 0 < self.overlap <= self.seconds / 2
        around = (self.before, self.after, self.past, self.ahead)
        if not (fits and 0 < self.seconds <= 600 and all(0 <= part < math.inf for part in around) and self.above >= 0):
            raise FaceDiffError(
                f"window: {self.seconds:g} s with an overlap of {self.overlap:g} s and {around} s around it is "
                f"impossible; choose e.g. 4 s, of which at most half overlaps"
            )

    def in_frames(self, frame_rate: float) -> FramePlan:
        """The same in whole frames."""
        lengths = (self.seconds, self.overlap, self.before, self.after, self.past, self.ahead)
        frames, overlap, before, after, past, ahead = (round(length * frame_rate) for length in lengths)
        if past:
            frames = max(1, frames)
            return FramePlan(frames, min(overlap, frames - 1), before, after, past, ahead)
        # Half of a window may be rounded up where the window is rounded down.
        overlap = max(1, min(overlap, frames // 2))
        if frames < 4:
            raise FaceDiffError(
                f"window: {self.seconds:g} s with an overlap of {self.overlap:g} s are too few frames at "
                f"{frame_rate:g} a second; choose longer windows"
            )
        return FramePlan(frames, overlap, before, after, past, ahead)

    def chosen(self, seconds: float | None, overlap: float | None) -> WindowPlan:
        """The plan with other lengths; None keeps a length."""
        length = self.seconds if seconds is None else seconds
        shared = min(self.overlap, length / 2) if overlap is None else overlap
        # A chosen window is used also with a model that otherwise takes speech of any length in one pass.
        above = self.above if seconds is None else min(self.above, WindowPlan.above)
        return replace(self, seconds=length, overlap=shared, above=above)

    def in_one_pass(self, frames: int, frame_rate: float) -> bool:
        """Whether so many frames are few enough to be animated in one pass."""
        return frames <= self.above * frame_rate

    @property
    def look_ahead(self) -> float:
        """Seconds of speech after an instant, at most, before its frame is certain: a whole window's, and after it."""
        return self.seconds + self.after


LOW_LATENCY = WindowPlan(seconds=1 / 30, overlap=0.0, before=0.4, after=0.08, above=0.0, past=1.0)
"""Windows of one frame that hear 0.08 s ahead and continue the last second of motion; see docs/streaming.md."""

LOW_LATENCY_AHEAD = replace(LOW_LATENCY, past=0.48, ahead=0.48)
"""The same for a model that draws noise for each frame; its motion depends on the noise before and after a frame."""

LOW_LATENCY_STEPS = 2
"""Denoising steps of such a window: the motion that it continues mostly decides its random part."""


@dataclass(frozen=True)
class FramePlan:
    """A :class:`WindowPlan` in frames."""

    frames: int
    overlap: int
    before: int
    after: int
    past: int = 0
    ahead: int = 0

    @property
    def look_ahead(self) -> int:
        """As :attr:`WindowPlan.look_ahead`, in whole frames."""
        return self.frames + self.after

    @property
    def hop(self) -> int:
        """Frames from the start of a window to the next one's, and how many are given out at a time."""
        return self.frames - self.overlap

    def window(self, index: int) -> MotionWindow:
        """A full window."""
        return MotionWindow(self, index, min(self.past, index * self.hop) + self.frames)


@dataclass(frozen=True)
class MotionWindow:
    """One window of long speech: its plan, its number, and its frames with its past; the last one has fewer."""

    plan: FramePlan
    index: int
    frames: int

    @property
    def fixed(self) -> int:
        """Its first frames, which are given out already."""
        return min(self.plan.past, self.index * self.plan.hop)

    @property
    def start(self) -> int:
        """Its first frame, counted from the start of the speech."""
        return self.index * self.plan.hop - self.fixed

    @property
    def end(self) -> int:
        """The frame after its last one."""
        return self.start + self.frames

    @property
    def context(self) -> int:
        """Frames before the window: the model receives their speech, but does not animate them."""
        return min(self.plan.before, self.start)

    @property
    def encoded(self) -> npt.NDArray[np.int64]:
        """Of which frame of the encoded speech each of its frames, and of those ahead, has the features."""
        # Silence after them would be taken for the end of the speech: the mouth would open a third too wide at onsets.
        heard = self.frames + self.plan.after
        return self.context + np.minimum(np.arange(self.frames + self.plan.ahead), heard - 1)

    @property
    def shared(self) -> int:
        """Its first frames, which belong to the window before it as well; 0 for the first window."""
        return self.fixed + self.plan.overlap if self.index else 0

    @property
    def kept(self) -> int:
        """Its last frames, which belong to the next window as well."""
        return self.plan.window(self.index + 1).shared

    @property
    def origins(self) -> list[tuple[int, slice]]:
        """The windows in which its frames, and those ahead of it, are new: index, and which of the new ones they are.

        All frames of the first window are new in it, and the last ones of every other.
        """
        origins, overlap, hop, last = [], self.plan.overlap, self.plan.hop, self.end + self.plan.ahead
        for index in range(max(0, (self.start - overlap) // hop), max(self.index, (last - 1 - overlap) // hop) + 1):
            first = index * hop + overlap if index else 0
            begin, end = max(self.start, first), min(last, (index + 1) * hop + overlap)
            if begin < end:
                origins.append((index, slice(begin - first, end - first)))
        return origins


def in_parts(
    stream: Any,  # noqa: ANN401 - feeds, finishes and counts frames, as SpeechWindows do
    speech: Any,  # noqa: ANN401 - an array or a tensor
    *,
    frames: int | None = None,
    progress: Callable[[Iterable[int]], Iterable[int]] | None = None,
) -> Iterator[Any]:
    """All motion of a stream for a recording, part by part; ``frames`` in all if given."""
    # Fed by the second, as from a microphone, so that memory does not grow with the recording.
    seconds = range(max(1, math.ceil(len(speech) / SAMPLE_RATE)))
    for second in seconds if progress is None else progress(seconds):
        before = stream.frames
        part = stream.feed(speech[second * SAMPLE_RATE : (second + 1) * SAMPLE_RATE])
        if stream.frames > before:
            yield part
    before = stream.frames
    part = stream.finish(frames)
    if stream.frames > before:
        yield part


class SpeechWindows(ABC, Generic[M]):
    """Animates speech that arrives in pieces, window by window; memory does not grow with its length.

    A frame is certain :attr:`WindowPlan.look_ahead` seconds later at most. The result depends on the speech up to then
    and the plan only, not on how the speech was cut into pieces: it is the same for a file and for a microphone. Each
    window's speech is standardised by mean and deviation of all speech heard up to the end of that window.

    Attributes:
        frames: how many have been given out so far.
    """

    def __init__(self, plan: FramePlan, frame_rate: float) -> None:
        self.plan = plan
        self.frame_rate = frame_rate
        self.frames = 0
        self._speech: Speech = np.zeros(0, np.float32)
        self._dropped = 0  # samples before these, which no window will hear again
        self._level = SpeechLevel()
        self._window = plan.window(0)  # the next one to generate, if the speech lasts
        self._held: Any = None  # the latest window's frames that the next one shares
        self._finished = False

    @abstractmethod
    def generate(self, window: MotionWindow, speech: Speech, frames: int, mean: float, deviation: float) -> M:
        """Motion of a window but for its past, which continues the window before it."""

    @abstractmethod
    def joined(self, parts: Sequence[M]) -> M:
        """Motion of consecutive frames in one piece; there may be no parts."""

    def feed(self, samples: Speech) -> M:
        """Take more speech at 16 kHz, and give the motion that has become certain; it may have no frames."""
        self._refuse_finished()
        self._speech = np.concatenate([self._speech, np.asarray(samples, np.float32)])
        parts = []
        # A window is generated once the speech after it has been heard too. Its last frames are held back: the next
        # window blends into them.
        while self._heard >= self._sample(self._window.end + self.plan.after):
            parts.append(self._next_window(self._window.end + self.plan.after))
        return self._counted(parts)

    def finish(self, frames: int | None = None) -> M:
        """Give the motion that is left."""
        self._refuse_finished()
        self._finished = True
        total = self._total(round(self._heard * self.frame_rate / SAMPLE_RATE), frames)
        self._speech = np.pad(self._speech, (0, max(0, self._sample(total) - self._heard)))
        parts = []
        while self._window.end < total:
            parts.append(self._next_window(min(total, self._window.end + self.plan.after)))
        # The rest lies within the last window. If it is no longer than the window before's motion, its
        # frames are certain now, since no later window will blend into them.
        left = total - self._window.start - self._window.fixed
        if self._held is not None and left <= self.plan.overlap:
            parts.append(self._held[:, :left])
        else:
            parts.append(self._generate(replace(self._window, frames=self._window.fixed + left), total))
        return self._counted(parts)

    def parts(self, speech: Speech, **options: Any) -> Iterator[M]:  # noqa: ANN401
        """All motion for a recording, part by part; options as of :func:`in_parts`."""
        return in_parts(self, speech, **options)

    @property
    def _heard(self) -> int:
        return self._dropped + len(self._speech)

    def _sample(self, frame: int) -> int:
        return samples_for(frame, self.frame_rate)

    def _next_window(self, samples: int) -> Any:  # noqa: ANN401 - an array or a tensor
        """The window's frames before its overlap with the next, given speech up to frame ``samples``; then advance."""
        motion = self._generate(self._window, samples)
        self._window = self.plan.window(self._window.index + 1)
        # Speech before the next window's context will not be heard again, unless the level has not counted it yet.
        needed = self._sample(self._window.start - self._window.context)
        drop = max(0, min(needed, self._level.count) - self._dropped)
        self._speech = self._speech[drop:]
        self._dropped += drop
        return motion[:, : self.plan.hop]

    def _generate(self, window: MotionWindow, samples: int) -> Any:  # noqa: ANN401 - an array or a tensor
        """Motion of a window, with speech up to frame ``samples``."""
        # Places in the whole recording; the kept speech starts at sample ``_dropped`` of it. Windows overlap, so the
        # level counts only new samples.
        start = window.start - window.context
        first, last = self._sample(start), self._sample(samples)
        self._level.add(self._speech[max(0, self._level.count - self._dropped) : last - self._dropped])
        speech = self._speech[first - self._dropped : last - self._dropped]
        # A window that is mostly a pause, standardised by itself, would turn its noise into loud speech.
        deviation = max(self._level.deviation, QUIETEST)
        if (end := window.end + self.plan.ahead) > samples:
            # At the mean, which is silence once it is standardised.
            padding = self._sample(end) - last
            speech, samples = np.pad(speech, (0, padding), constant_values=self._level.mean), end
        motion: Any = self.generate(window, speech, samples - start, self._level.mean, deviation)
        self._held = motion[:, motion.shape[1] - self.plan.overlap :]
        return motion

    def _counted(self, parts: Sequence[Any]) -> M:
        self.frames += sum(part.shape[1] for part in parts)
        return self.joined(parts)

    def _total(self, of_speech: int, frames: int | None) -> int:
        """The number of frames in all: of the speech, or as asked for."""
        total = of_speech if frames is None else frames
        if of_speech < 1 or total < max(1, self.frames):
            raise FaceDiffError(
                f"frames: {total} of speech that lasts {of_speech}; a frame takes {1 / self.frame_rate:.3f} s, and "
                f"{self.frames} were given out already"
            )
        return total

    def _refuse_finished(self) -> None:
        if self._finished:
            raise FaceDiffError("the stream is finished; start another one for more speech")


class SpeechLevel:
    """Mean and standard deviation of all samples so far; both are 0 before there is a sample."""

    def __init__(self) -> None:
        self.count = 0
        self._sum = 0.0
        self._squares = 0.0

    def add(self, samples: Speech) -> None:
        """Count more samples in."""
        wide = np.asarray(samples, np.float64)
        self.count += len(wide)
        self._sum += float(wide.sum())
        self._squares += float(np.square(wide).sum())

    @property
    def mean(self) -> float:
        """Mean."""
        return self._sum / max(self.count, 1)

    @property
    def deviation(self) -> float:
        """Population standard deviation."""
        return math.sqrt(max(0.0, self._squares / max(self.count, 1) - self.mean**2))
