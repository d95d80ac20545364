"""How long speech is cut: windows that overlap, and the speech around each that is heard with it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from facediff.errors import FaceDiffError


@dataclass(frozen=True)
class Window:
    """One window of long speech, in frames.

    Attributes:
        index: how many windows came before it.
        context: frames before the window whose speech is heard with it, but not animated.
        frames: frames of the window.
        shared: its first frames, which the window before it has had as well; 0 for the first.
        kept: its last frames, which the next one will have as well.
        fresh: frames that a full window at its place has and the one before has not.
        fresh_before: the same of the window before it.
    """

    index: int
    context: int
    frames: int
    shared: int
    kept: int
    fresh: int
    fresh_before: int


@dataclass(frozen=True)
class WindowPlan:
    """Lengths in seconds.

    Models of this field learn from sentences of three to five seconds. Windows of that length are what they know; one
    that learnt from longer clips may do better with longer windows, and must be at ease with speech up to ``above``.

    Attributes:
        seconds: length of a window.
        overlap: how much of it the next one has as well; at most half of it.
        before: speech before the window that is heard with it.
        after: speech after the window that is heard with it.
        above: speech that lasts longer than this is animated by windows; shorter speech at once. Infinite: always at
            once.

    Raises:
        FaceDiffError: if a length is impossible.
    """

    seconds: float = 4.0
    overlap: float = 1.0
    before: float = 2.0
    after: float = 0.5
    above: float = 10.0

    def __post_init__(self) -> None:
        if not 0 < self.seconds <= 600:
            raise FaceDiffError(f"window: {self.seconds:g} s is impossible; choose e.g. 4")
        if not 0 < self.overlap <= self.seconds / 2:
            raise FaceDiffError(
                f"overlap: {self.overlap:g} s is impossible with windows of {self.seconds:g} s; choose more than 0, at "
                f"most half of a window"
            )
        if not (0 <= self.before < math.inf and 0 <= self.after < math.inf and self.above >= 0):
            raise FaceDiffError("window: the speech before and after a window cannot last less than 0 s, nor for ever")

    def in_frames(self, frame_rate: float) -> FramePlan:
        """The same in whole frames.

        Raises:
            FaceDiffError: if windows are too short for frames.
        """
        frames = round(self.seconds * frame_rate)
        # Half of a window may be rounded up where the window is rounded down.
        overlap = max(1, min(round(self.overlap * frame_rate), frames // 2))
        if frames < 4:
            raise FaceDiffError(
                f"window: {self.seconds:g} s with an overlap of {self.overlap:g} s are too few frames at "
                f"{frame_rate:g} a second; choose longer windows"
            )
        return FramePlan(frames, overlap, round(self.before * frame_rate), round(self.after * frame_rate))

    def at_once(self, frames: int, frame_rate: float) -> bool:
        """Whether so many frames are short enough to be animated at once."""
        return frames <= self.above * frame_rate

    @property
    def look_ahead(self) -> float:
        """Seconds of speech, at most, that must be heard after an instant before its frame is certain.

        The first frame of a window waits for the whole window and for the speech after it.
        """
        return self.seconds + self.after


@dataclass(frozen=True)
class FramePlan:
    """A :class:`WindowPlan` in frames.

    Attributes:
        frames: of a window.
        overlap: shared by neighbours.
        before: heard before a window.
        after: heard after it.
    """

    frames: int
    overlap: int
    before: int
    after: int

    @property
    def hop(self) -> int:
        """Frames from the start of a window to that of the next."""
        return self.frames - self.overlap

    def window(self, index: int, frames: int) -> Window:
        """The window of an index; ``frames`` long, which is less than usual for the last one."""
        return Window(
            index=index,
            context=min(self.before, index * self.hop),
            frames=frames,
            shared=self.overlap if index else 0,
            kept=self.overlap,
            fresh=self.hop if index else self.frames,
            fresh_before=self.hop if index > 1 else self.frames,
        )
