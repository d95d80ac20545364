"""The loop of a live performance: speech goes to the model, and its frames are sent when they are due.

Three threads: the source's, which only hands samples over; the model's; and the caller's, which waits for the time of
each frame and gives it to the receivers. Between them are a :class:`Backlog` of speech and a queue of frames, both of
bounded length: what cannot be animated or sent in time is dropped and counted, and a performance never falls behind.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from operator import methodcaller

import numpy as np
import numpy.typing as npt

from facediff.animation.animation import without_head
from facediff.errors import counted
from facediff.live.frames import LiveFrame, Receiver
from facediff.live.model import LiveModel
from facediff.live.sources import Speech, SpeechSource
from facediff.live.timing import Lags, Pacer, SpokenClock, Thinning
from facediff.speech.audio import samples_for
from facediff.utils import SAMPLE_RATE

Array = npt.NDArray[np.float32]
Solver = Callable[[Array], Array]
"""Offsets (V, 3) of a frame to weights of blendshapes (K,)."""

PATIENCE = (0.5, 3.0)
"""Least and most seconds of speech that may wait for a model which usually is fast enough: as many as its look-ahead
has: with long windows, buffering is better than dropping speech."""

HURRIED = 0.25
"""The same for a model that is too slow: speech that waits would only make all frames late."""

THINNED = 3.0
"""The same while frames can still be left out, which gives the model time: speech goes last."""

RECENT = 3.0
"""Seconds of speech over which a model's speed is measured."""


@dataclass
class LiveSummary:
    """Figures of a performance; seconds but for the counts of frames."""

    frames: int = 0  # that were sent
    dropped: int = 0  # frames that came too late to be sent, or were left out to give the model time
    speech: float = 0.0  # that was received
    lost: float = 0.0  # speech that was dropped because the model was too slow
    busy: float = 0.0  # in which the model has computed
    lag: Lags = field(default_factory=Lags)  # from a frame's last sample until the frame was sent
    waiting: Lags = field(default_factory=Lags)  # of that, from the moment the frame was ready
    computing: Lags = field(default_factory=Lags)  # of a window
    sending: Lags = field(default_factory=Lags)  # in which a frame was solved for and given to the receivers
    receivers: dict[str, str] = field(default_factory=dict)  # the reports of each of them, by name

    @property
    def factor(self) -> float:
        """Seconds of computing for each second of speech."""
        return self.busy / max(self.speech - self.lost, 1e-9)

    def sentences(self) -> list[str]:
        """The report at the end."""
        lines = [
            f"{counted(self.frames, 'frame')} of {self.speech:.1f} s; lag {self.lag}; "
            f"{dropped_text(self.dropped, self.lost)}",
            f"computing {self.computing} a window (real-time factor {self.factor:.2f}); sending {self.sending} a frame",
        ]
        return lines + [f"{name}: {status}" for name, status in self.receivers.items() if status]


def dropped_text(frames: int, speech: float) -> str:
    """A sentence about dropped frames, and seconds of speech, for the run and its end."""
    return f"{counted(frames, 'frame')} dropped" + (f", {speech:.1f} s of speech" if speech else "")


class Backlog:
    """Speech that waits for the model, ``limit`` seconds at most; the oldest is dropped then, in whole frames."""

    def __init__(self, frame_rate: float, limit: float) -> None:
        self.frame_rate = frame_rate
        self.limit = limit
        self.dropped = 0  # frames
        self._pieces: deque[Speech] = deque()
        self._waiting = 0  # samples
        self._ended = False
        self._changed = threading.Condition()

    def put(self, samples: Speech) -> None:
        """Add speech; never waits."""
        with self._changed:
            self._pieces.append(samples)
            self._waiting += len(samples)
            # Half of the limit is left, so that there are few gaps rather than many.
            if self._waiting > self.limit * SAMPLE_RATE:
                self._drop(self._waiting - round(self.limit / 2 * SAMPLE_RATE))
            self._changed.notify()

    @property
    def waiting(self) -> float:
        """Seconds of speech that wait."""
        return self._waiting / SAMPLE_RATE

    def _drop(self, least: int) -> None:
        """Drop the oldest samples: frames that they last as a whole."""
        frames = math.floor(least * self.frame_rate / SAMPLE_RATE)
        # Counted from the start, so that frames which are no whole number of samples do not add up to an error.
        samples = samples_for(self.dropped + frames, self.frame_rate) - samples_for(self.dropped, self.frame_rate)
        remainder = np.concatenate(self._pieces)[samples:]
        self._pieces = deque([remainder])
        self._waiting = len(remainder)
        self.dropped += frames

    def end(self) -> None:
        """No more speech comes."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def take(self, limit: float) -> tuple[Speech, int] | None:
        """Wait for speech, and take it: samples, and how many frames were dropped before them; None at the end.

        Args:
            limit: seconds that are taken at most.
        """
        with self._changed:
            while not self._waiting and not self._ended:
                self._changed.wait()
            if not self._waiting:
                return None
            speech = np.concatenate(self._pieces)
            count = min(len(speech), max(1, round(limit * SAMPLE_RATE)))
            self._pieces = deque([speech[count:]]) if count < len(speech) else deque()
            self._waiting -= count
            return speech[:count], self.dropped


@dataclass(frozen=True)
class _Ready(LiveFrame):
    """A frame that waits for its time."""

    ready: float = 0.0


class Loop:
    """One performance, from the first sample to the last frame.

    Args:
        model: animates.
        source: of the speech.
        receivers: of the frames; they are open, and closed by the caller.
        hearing: whether receivers play the speech.
        solve: finds weights of blendshapes for receivers that need them; None to send those that the model gives.
        seconds: of speech, after which it ends; None for the source's own end.
        report: prints a sentence.
        every: seconds between reports; None for reports of a slow model alone.
    """

    def __init__(
        self,
        model: LiveModel,
        source: SpeechSource,
        receivers: Sequence[Receiver],
        *,
        hearing: bool = False,
        solve: Solver | None = None,
        seconds: float | None = None,
        report: Callable[[str], None] = print,
        every: float | None = 5.0,
    ) -> None:
        self.model, self.source, self.receivers, self.hearing = model, source, receivers, hearing
        self.summary = LiveSummary()
        self.clock = SpokenClock()
        self.pacer = Pacer(model.hop)
        self._solve, self._seconds, self._report, self._every = solve, seconds, report, every
        self._patience = min(max(PATIENCE[0], model.look_ahead), PATIENCE[1])
        self._backlog = Backlog(model.frame_rate, model.hop + self._patience)
        self._thinning = Thinning(model.frame_rate)
        self._slow = False
        self._stopped = threading.Event()
        self._changed = threading.Condition()
        self._frames: deque[_Ready] = deque()
        self._spoken: deque[tuple[Speech, float]] = deque()  # speech for receivers that play it
        self._ended = False
        self._error: BaseException | None = None
        self._interval = Lags()
        self._abandoned = False  # the frames that are left are not needed
        self._slow_reported = False
        self._failing: set[str] = set()  # names of receivers that have raised

    def run(self) -> LiveSummary:
        """Perform until the speech ends, ``seconds`` have been heard, or Ctrl-C."""
        listening = threading.Thread(target=self._guard(self._listen), name="speech", daemon=True)
        animating = threading.Thread(target=self._guard(self._animate), name="model", daemon=True)
        listening.start()
        animating.start()
        try:
            self._send_all()
        except KeyboardInterrupt:  # how most performances end
            self._abandoned = True
        finally:
            self._stopped.set()
            self._backlog.end()
            animating.join(timeout=5.0)  # a source may wait for its next sample for ever
            self.summary.receivers = {receiver.name: receiver.status() for receiver in self.receivers}
        if self._error is not None:
            raise self._error
        return self.summary

    def _guard(self, work: Callable[[], None]) -> Callable[[], None]:
        """A thread's work; its error ends the performance and is raised where it was started."""

        def guarded() -> None:
            try:
                work()
            except BaseException as error:  # noqa: BLE001 - raised by run
                self._error = self._error or error
            finally:
                self._backlog.end()
                if work == self._animate:  # no more frames come; an error of the source leaves some to be finished
                    with self._changed:
                        self._ended = True
                        self._changed.notify()

        return guarded

    # The source's thread.

    def _listen(self) -> None:
        """Take speech from the source."""
        sample_count, limit = 0, math.inf if self._seconds is None else round(self._seconds * SAMPLE_RATE)

        def deliver(samples: Speech, at: float) -> None:
            nonlocal sample_count
            samples = samples[: int(min(len(samples), limit - sample_count))]
            if not len(samples) or self._stopped.is_set():
                return
            start, sample_count = sample_count / SAMPLE_RATE, sample_count + len(samples)
            with self._changed:
                self.clock.arrived(sample_count / SAMPLE_RATE, at)
                self.summary.speech = sample_count / SAMPLE_RATE
                if self.hearing:
                    self._spoken.append((samples, start))
                    self._changed.notify()
            self._relieve()
            self._backlog.put(samples)
            if sample_count >= limit:
                self._stopped.set()
                self._backlog.end()  # the source may wait long before it notices

        self.source.run(deliver, self._stopped)

    def _relieve(self) -> None:
        """Send fewer frames while speech waits, and let none of it be dropped before."""
        self._thinning.waiting(behind=self._backlog.waiting > self.model.hop + HURRIED)
        allowed = THINNED if not self._thinning.at_most else HURRIED if self._slow else self._patience
        self._backlog.limit = self.model.hop + allowed

    # The model's thread.

    def _animate(self) -> None:
        """Turn speech into frames."""
        stream = self.model.start()
        fed, frame_count = 0, 0  # samples, and frames of the stream, which does not know of dropped ones
        gaps: deque[tuple[int, int]] = deque([(0, 0)])  # from which frame of the stream on how many were dropped before
        recent: deque[tuple[float, float]] = deque()  # seconds of computing, seconds of speech
        while (piece := self._backlog.take(max(self.model.hop, 0.02))) is not None and not self._abandoned:
            samples, dropped = piece
            if dropped != gaps[-1][1]:
                gaps.append((math.ceil(fed * self.model.frame_rate / SAMPLE_RATE), dropped))
                self.summary.lost = dropped / self.model.frame_rate
            before, began = stream.made, time.monotonic()
            points = stream.feed(samples)
            timestamp = time.monotonic()
            fed += len(samples)
            if stream.made > before:
                self.summary.computing.add(timestamp - began)
            recent.append((timestamp - began, len(samples) / SAMPLE_RATE))
            self._measure(recent)
            frame_count = self._ready(points, stream.heads, frame_count, gaps, timestamp)
        if fed and not self._abandoned:
            self._thinning.stride = 1  # nothing waits any more, and the last frame shuts the mouth
            before, began = stream.made, time.monotonic()
            points = stream.finish()
            timestamp = time.monotonic()
            self.summary.busy += timestamp - began
            if stream.made > before:
                self.summary.computing.add(timestamp - began)
            self._ready(points, stream.heads, frame_count, gaps, timestamp)

    def _measure(self, recent: deque[tuple[float, float]]) -> None:
        """Find out whether the model is fast enough; if not, little speech may wait for it once frames are left out."""
        computed, seconds_of_speech = recent[-1][0], sum(speech for _, speech in recent)
        self.summary.busy += computed
        hop = self.model.hop
        enough = max(RECENT, 2 * hop)
        while seconds_of_speech - recent[0][1] > enough:
            seconds_of_speech -= recent.popleft()[1]
        # A process that was stopped for a while has one long window: it counts as the next longest.
        longest = sorted((seconds for seconds, _ in recent), reverse=True)
        factor = (sum(longest) - longest[0] + longest[min(1, len(longest) - 1)]) / max(seconds_of_speech, 1e-9)
        self._slow = seconds_of_speech > 0.9 * enough and factor > 1
        if self._slow and not self._slow_reported:
            self._slow_reported = True
            self._report(
                f"the model takes {factor:.2f} s for a second of speech on this machine, so that frames and then "
                f"speech are dropped: export it with fewer --steps and --quick-steps, choose a longer --window or a "
                f"shorter --overlap, or end other programs"
            )

    def _ready(
        self,
        points: Array,
        heads: npt.NDArray[np.float64] | None,
        first: int,
        gaps: deque[tuple[int, int]],
        timestamp: float,
    ) -> int:
        """Queue frames of the stream, the first of which has the number ``first``; the number of the next."""
        if not len(points):
            return first
        decoder = self.model.decoder
        values = [None] * len(points) if decoder is None else decoder.values(points)
        offsets = (points if decoder is None else decoder.vertices(points)) - self.model.neutral
        with self._changed:
            for row, frame_offsets in enumerate(offsets):
                while len(gaps) > 1 and gaps[1][0] <= first + row:
                    gaps.popleft()
                index = first + row + gaps[0][1]
                speech_time = self.clock.spoken((index + 1) / self.model.frame_rate)
                if row == 0:
                    self.pacer.ready(speech_time, timestamp)
                head = None if heads is None else heads[row]
                times = index / self.model.frame_rate, speech_time
                self._frames.append(_Ready(index, *times, frame_offsets, values[row], head=head, ready=timestamp))
            self._changed.notify()
        return first + len(points)

    # The caller's thread.

    def _send_all(self) -> None:
        """Give every frame to the receivers when it is due, until there are no more."""
        reported = time.monotonic()
        weights: tuple[int, Array | None] = (-1, None)  # of which frame
        while True:
            with self._changed:
                while not (self._frames or self._spoken or self._ended):
                    self._changed.wait()
                while self._frames and not self._thinning.sends(self._frames[0].index):
                    self._frames.popleft()
                    self.summary.dropped += 1
                speech, frame = list(self._spoken), self._frames[0] if self._frames else None
                self._spoken.clear()
                if frame is None and self._ended and not speech:
                    return
            for samples, start in speech:
                self._each(methodcaller("hear", samples, start))
            if frame is None:
                continue
            if weights[0] != frame.index and self._solve is not None and not self._late(frame):
                began = time.monotonic()
                weights = frame.index, self._solve(self._still(frame))
                solving = time.monotonic() - began
            else:
                solving = 0.0
            if not self._wait_for(frame):
                continue
            with self._changed:
                self._frames.popleft()
            unsolved = self._solve is not None and weights[0] != frame.index  # it was late, until the delay grew
            if unsolved or self._late(frame):
                self.summary.dropped += 1
            else:
                self._send(frame, weights[1] if weights[0] == frame.index else frame.weights, solving)
            if self._every is not None and time.monotonic() - reported > self._every:
                reported = time.monotonic()
                self._tell()

    def _wait_for(self, frame: _Ready) -> bool:
        """Wait until a frame is due; False if there is speech to be handed over before."""
        with self._changed:
            while (early := self.pacer.due(frame.heard) - time.monotonic()) > 0:
                if self._spoken:
                    return False
                self._changed.wait(early)
        return True

    def _late(self, frame: _Ready) -> bool:
        """Whether a frame's time has passed by more than a hop, and a later one is there, which is more urgent."""
        newer = self._frames and self._frames[-1].index > frame.index
        return bool(newer) and time.monotonic() > self.pacer.due(frame.heard) + self.model.hop

    def _still(self, frame: _Ready) -> Array:
        """Offsets of a frame's vertices without the motion of the head, which shapes of a face cannot express."""
        if frame.head is None or not frame.head.any():
            return frame.vertices  # to the last bit
        neutral = self.model.neutral
        (vertices,) = without_head((neutral + frame.vertices)[None], frame.head[None])
        return np.asarray(vertices - neutral, np.float32)

    def _send(self, frame: _Ready, weights: Array | None, solving: float) -> None:
        began = time.monotonic()
        out = replace(frame, weights=weights, dropped=self.summary.dropped + self._backlog.dropped)
        self._each(methodcaller("send", out))
        timestamp = time.monotonic()
        self.summary.frames += 1
        self.summary.lag.add(timestamp - frame.heard)
        self._interval.add(timestamp - frame.heard)
        self.summary.waiting.add(began - frame.ready)
        self.summary.sending.add(timestamp - began + solving)

    def _each(self, do: Callable[[Receiver], None]) -> None:
        """Do something with every receiver; one that fails, which none should, does not end the others."""
        for receiver in self.receivers:
            try:
                do(receiver)
            except Exception as error:  # noqa: BLE001 - a third party's receiver may raise anything
                if receiver.name not in self._failing:
                    self._failing.add(receiver.name)
                    self._report(f"{receiver.name}: {type(error).__name__}: {error}")

    def _tell(self) -> None:
        """Report on the last seconds."""
        parts = [f"{self.summary.speech:.0f} s: lag {self._interval}"]
        parts.append(dropped_text(self.summary.dropped, self._backlog.dropped / self.model.frame_rate))
        parts += [f"{receiver.name}: {status}" for receiver in self.receivers if (status := receiver.status())]
        self._interval = Lags()
        self._report("; ".join(parts))
