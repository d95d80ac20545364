"""One recording in parameters, as a file holds it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged
from facediff.spaces.operations import at_times
from facediff.spaces.space import Space
from facediff.utils.hints import check_number
from facediff.utils.limits import FRAME_RATES
from facediff.utils.numerics import Array, Floats

Values = npt.NDArray[np.float32]

MOST_MISSING = 3600
"""Frames that may be missing between two rows, a minute at 60 a second; they are interpolated."""

USUAL_RATES = (24.0, 25.0, 30.0, 48.0, 50.0, 60.0)
NEAR_RATE = 0.01
"""Share by which the rate of rows may differ from a usual one and still be it."""

LARGEST = 1e6
"""Largest absolute value of a channel; weights, radians and coefficients in standard deviations are far below."""


@dataclass(frozen=True, eq=False)
class ParameterClip:
    """Values of a recording and their space."""

    name: str
    values: Values  # (T, C) as the file has them: weights above 1 and below 0 are kept
    space: Space
    frame_rate: float
    times: Array | None = None  # (T,) seconds from the first row on, as files state them; None where rows follow evenly
    start: float = 0.0  # seconds since midnight of the first row, by its timecode
    identity: Values | None = None  # (S,) the person's coefficients, where the file has them
    layout: str = ""  # name of the layout that the file is in
    notes: tuple[str, ...] = ()  # findings of the reader, a sentence each

    @property
    def dropped(self) -> int:
        """Rows that are missing between others, by their times."""
        if self.times is None or len(self.times) < 2:
            return 0
        return int(np.maximum(np.rint(np.diff(self.times) * self.frame_rate) - 1, 0).sum())

    @property
    def duration(self) -> float:
        """Seconds from the first row to the end of the last one."""
        last = (len(self.values) - 1) / self.frame_rate if self.times is None else float(self.times[-1])
        return last + 1 / self.frame_rate


def even(clip: ParameterClip) -> ParameterClip:
    """The clip with a row at every multiple of its frame's length; dropped rows are interpolated."""
    if clip.times is None:
        return clip
    count = round(float(clip.times[-1]) * clip.frame_rate) + 1
    values = at_times(clip.values, clip.space, clip.times, np.arange(count) / clip.frame_rate)
    return replace(clip, values=values.astype(np.float32), times=None)


def from_start(clip: ParameterClip, rate: float) -> Array:
    """Values (T, C) at a rate from the beginning of the sound, of a clip with even rows.

    BEAT's first frame lies 1/60 s after it, an excerpt's later; a timecode begins at the time of day.
    """
    times = (0.0 if clip.layout == "live_link" else clip.start) + np.arange(len(clip.values)) / clip.frame_rate
    return at_times(clip.values, clip.space, times, np.arange(int(times[-1] * rate + 1e-6) + 1) / rate)


def checked(path: Path, values: Floats, frame_rate: float) -> Values:
    """Values of a file (T, C) as float32, finite."""
    check_number(path, "frame rate", frame_rate, *FRAME_RATES)
    sound = (np.abs(values) <= LARGEST).all(axis=1)
    if not len(values) or not sound.all():
        problem = (
            f"frame {int(np.argmin(sound))} holds NaN or a number beyond {LARGEST:g}" if len(values) else "no frames"
        )
        raise FaceDiffError(f"{path}: {problem}; record it again")
    return np.ascontiguousarray(values, np.float32)


def columns_of(path: Path, header: Sequence[str], space: Space) -> list[int]:
    """The column of each channel of a space in a header."""
    columns = {name: index for index, name in enumerate(header)}
    with damaged(path, f"expected columns of {len(space.channels)} channels"):
        return [columns[name] for name in space.channels]


def rate_of(path: Path, times: Array, places: Sequence[str], stated: float | None = None) -> float:
    """Rows a second, as stated or by the median step between times (T,): a usual rate where it is near one.

    The number of rows says nothing, since recorders drop some. Times must ascend, with no more rows missing than a
    recorder drops; ``places`` name the rows.
    """
    later = np.isfinite(times) & (np.diff(times, prepend=-np.inf) > 0)
    if not later.all() or (stated is None and len(times) < 2):
        row = places[int(np.argmin(later))] if len(times) else "the table"
        raise FaceDiffError(f"{path}: {row} is no later than the one before it, or alone; expected times that ascend")
    if stated is None:
        measured = 1.0 / float(np.median(np.diff(times)))
        nearest = min(USUAL_RATES, key=lambda rate: abs(rate - measured))
        stated = nearest if abs(measured / nearest - 1) < NEAR_RATE else round(measured, 3)
    steps = np.diff(times)
    if steps.max(initial=0.0) * stated > MOST_MISSING:
        at = int(steps.argmax())
        raise FaceDiffError(
            f"{path}: {places[at + 1]} comes {steps[at]:.0f} s after {places[at]}; cut the recording there, or correct "
            f"its time"
        )
    return stated


def shortest(value: np.float32) -> str:
    """The shortest decimal that is read as the same float32."""
    return np.format_float_positional(value, unique=True, trim="0")
