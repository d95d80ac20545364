"""Clocks of a live performance: when speech was spoken, when its frames are due, and how late they were.

All times are seconds of :func:`time.monotonic`.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from time import monotonic

import numpy as np

MEMORY = 5.0
"""Seconds of arrivals and bursts that are remembered."""

GAP = 0.5
"""Seconds by which speech must come late for the source to have paused."""

MARGIN = 0.01
"""Seconds by which a frame is ready before it is due, at least."""

GROWTH = 0.1
"""Seconds, or a hop if that is longer, by which the delay grows beyond the least that bursts have needed: a machine
that is slower than that drops frames."""

SHRINKING, HURRY, FASTEST = 0.01, 0.2, 0.1
"""Seconds by which the delay shrinks in a second: frames then follow each other 1 % faster, which is invisible; a delay
that is far too long, after a time in which the machine was busy, shrinks faster by its excess, up to 10 %."""


class SpokenClock:
    """When a moment of speech was spoken, from when its samples arrived.

    Samples arrive in blocks, and some of them late. A moment counts as spoken when its sample would have arrived
    without any such delay: by the earliest arrival of the last seconds, so that clocks of sound cards may drift.

    Attributes:
        offset: added to the latest moments; read by other threads.
    """

    def __init__(self) -> None:
        self.offset = 0.0
        self._earliest: deque[tuple[float, float]] = deque()  # (when, arrival − moment), later ones larger
        self._before: deque[tuple[float, float]] = deque()  # (moment, offset) of speech before a pause of the source

    def arrived(self, moment: float, at: float) -> None:
        """All speech up to a moment, in seconds from the start, had arrived at a time."""
        offset = at - moment
        if self._earliest and offset > self._earliest[0][1] + GAP:
            self._before.append((moment, self._earliest[0][1]))
            self._earliest.clear()
        while self._earliest and self._earliest[-1][1] >= offset:
            self._earliest.pop()
        self._earliest.append((at, offset))
        while self._earliest[0][0] < at - MEMORY:
            self._earliest.popleft()
        self.offset = self._earliest[0][1]
        while self._before and self._before[0][0] < moment - 60:
            self._before.popleft()

    def spoken(self, moment: float) -> float:
        """When a moment of speech was spoken.

        Example:
            >>> clock = SpokenClock()
            >>> clock.arrived(0.02, 100.02)
            >>> clock.arrived(0.04, 100.05)  # 10 ms late
            >>> round(clock.spoken(0.04), 3)
            100.04
        """
        for until, offset in self._before:
            if moment < until:
                return moment + offset
        return moment + self.offset


class Pacer:
    """The delay between speech and its frames: constant, so that frames follow each other at their rate.

    Frames come in bursts, a hop of the windows at a time; the first of a burst has waited longest for the others. The
    delay is what those frames need, and a margin. It grows when a burst comes late, within limits, and shrinks slowly
    when it has been longer than necessary.

    Args:
        hop: seconds of a burst.
    """

    def __init__(self, hop: float) -> None:
        self.hop = hop
        self.delay: float | None = None
        self._needed: deque[tuple[float, float]] = deque()  # (time, seconds that a burst needed)
        self._changed = 0.0

    def ready(self, speech_time: float, timestamp: float) -> None:
        """The first frame of a burst has become ready; its speech was spoken at a time."""
        needed = timestamp - speech_time
        self._needed.append((timestamp, needed))
        while self._needed[0][0] < timestamp - MEMORY:
            self._needed.popleft()
        all_needed = [need for _, need in self._needed]
        if self.delay is None:
            self.delay = needed + 2 * MARGIN
        elif needed + MARGIN > self.delay:
            self.delay = min(needed + MARGIN, max(self.delay, min(all_needed) + max(self.hop, GROWTH)))
        else:
            enough = min(self.delay, max(all_needed) + MARGIN)
            rate = min(FASTEST, SHRINKING + HURRY * max(0.0, self.delay - enough - GROWTH))
            self.delay = max(enough, self.delay - rate * min(MEMORY, timestamp - self._changed))
        self._changed = timestamp

    def due(self, speech_time: float) -> float:
        """When the frame of a moment of speech is due."""
        return speech_time + (self.delay or 0.0)


class Thinning:
    """Which frames are sent while the model falls behind: every one, every second, fourth … as speech goes on waiting.

    A frame that is not sent costs neither blendshapes nor receivers' time, and is hardly missed; speech that is not
    animated is a syllable without a mouth. So frames go first, until so few are left that a face would be a slide show.
    """

    FEWEST = 6.0  # Frames a second that are always sent
    SETTLING = 0.4  # Seconds that a step must have before the next one
    CALM = 3.0  # Seconds without waiting speech after which more frames are sent

    def __init__(self, frame_rate: float) -> None:
        self.stride = 1
        self._most = max(1, int(frame_rate / self.FEWEST))
        self._changed = self._behind = -math.inf

    @property
    def at_most(self) -> bool:
        """Whether no more frames can be spared, and the last step has had its time."""
        return self.stride == self._most and monotonic() > self._changed + self.SETTLING

    def waiting(self, *, behind: bool) -> None:
        """Take note of whether more speech waits than usual."""
        timestamp = monotonic()
        if behind:
            self._behind = timestamp
            if self.stride < self._most and timestamp > self._changed + self.SETTLING:
                self.stride, self._changed = min(2 * self.stride, self._most), timestamp
        elif self.stride > 1 and timestamp > max(self._changed, self._behind) + self.CALM:
            self.stride, self._changed = self.stride // 2, timestamp

    def sends(self, index: int) -> bool:
        """Whether the frame of a number is sent."""
        return index % self.stride == 0


class Lags:
    """A distribution of seconds.

    Example:
        >>> lags = Lags()
        >>> for lag in (0.1, 0.2, 0.9):
        ...     lags.add(lag)
        >>> round(lags.share(0.5), 3), round(lags.worst, 3)
        (0.2, 0.9)
    """

    def __init__(self) -> None:
        self._seconds = array("f")  # 4 bytes each: an hour takes half a megabyte

    def add(self, seconds: float) -> None:
        """Count one more."""
        self._seconds.append(seconds)

    def share(self, share: float) -> float:
        """The seconds that a share of all do not exceed; 0.5 for the median. NaN if there are none."""
        return float(np.quantile(self._seconds, share, method="inverted_cdf")) if self._seconds else math.nan

    @property
    def worst(self) -> float:
        """The longest."""
        return self.share(1.0)

    def __str__(self) -> str:
        """Median, 95 % and worst in milliseconds."""
        if not self._seconds:
            return "none"
        return ", ".join(
            f"{1000 * self.share(share):.0f} ms {name}"
            for share, name in ((0.5, "median"), (0.95, "95 %"), (1, "worst"))
        )
