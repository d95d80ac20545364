"""Tables: recordings of Live Link Face, and the weights that Audio2Face writes (.csv)."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError, damaged, note
from facediff.spaces.arkit import ARKIT, ROTATIONS, live_link_name
from facediff.spaces.files.clips import ParameterClip, checked, columns_of, rate_of, shortest
from facediff.spaces.layouts import layout
from facediff.spaces.operations import permuted, with_apples_mouth
from facediff.utils.files import atomic
from facediff.utils.limits import quoted
from facediff.utils.numerics import Array, Floats
from facediff.utils.plain_files import read_columns, write_table

Values = Floats

DAY = 24 * 3600
TIMECODE, COUNT = "Timecode", "BlendShapeCount"
REMEDY = "expected a table as Live Link Face or Audio2Face writes it"
SIXTIETHS = 60
"""Unit of the last field of a timecode, as parts of a second; it does not depend on the recorded rate."""
TIMECODE_RATES = (24, 25, 30, 48, 50)
"""Frames a second that programs count in that field."""
_MIRRORED = np.array([not name.endswith("Pitch") for name in ROTATIONS])
"""The app's rotations with the opposite sign of a right-handed face that looks along +z.

In its recordings, eyeLookOutLeft and eyeLookInRight come with negative yaws, eyeLookDown with positive pitches, and the
eyes' rolls are the products of both: a mirrored frame, in which yaw and roll change their signs. Heads were not seen
to move in these recordings; they are taken to be in the same frame."""
LOOK = {"sideways": 0.60, "down": 0.61, "up": 0.44}
"""Radians by which the app turns an eye at a weight of 1 of its ``eyeLook`` shapes, as its recordings have them."""
_TIMECODE = re.compile(r"(\d{1,2}):(\d{1,2}):(\d{1,2})[:;](\d{1,2}(?:\.\d{1,9})?)")


def live_link_header() -> list[str]:
    """The columns of a recording: timecode, number of values, ARKit's 52 names, rotations of head and eyes."""
    return [TIMECODE, COUNT, *map(live_link_name, ARKIT), *ROTATIONS]


def timecode(seconds: float) -> str:
    """HH:MM:SS:FF.fff of a time, from midnight on, with FF.fff in sixtieths of a second.

    Unreal Engine's importer of such tables divides the frames by 60 at any rate (its later versions by 30 where no
    frame number exceeds 30) and reads the fraction; sixtieths therefore put each frame at its time.
    """
    thousandths = round(seconds * 60_000) % (DAY * 60_000)
    time, fraction = divmod(thousandths, 60_000)
    return f"{time // 3600:02d}:{time // 60 % 60:02d}:{time % 60:02d}:{fraction // 1000:02d}.{fraction % 1000:03d}"


def fields_of(text: str) -> tuple[int, float] | None:
    """Whole seconds since midnight of a timecode, and its last field; None for anything else.

    Example:
        >>> fields_of("00:00:01:30.000"), fields_of("1:30")
        ((1, 30.0), None)
    """
    match = _TIMECODE.fullmatch(text.strip())
    if match is None:
        return None
    hours, minutes, seconds = (int(part) for part in match.groups()[:3])
    parts = float(match[4])
    if hours > 23 or minutes > 59 or seconds > 59 or parts >= SIXTIETHS:
        return None
    return hours * 3600 + minutes * 60 + seconds, parts


def _clock(path: Path, stamps: Array) -> Array:
    """Seconds (T,) from midnight on of whole seconds and last fields (T, 2); past midnight, the clock begins again.

    The app counts sixtieths in the last field, other programs frames: where a second ends, it begins again at their
    number.
    """
    seconds = stamps[:, 0] + DAY * np.cumsum(np.diff(stamps[:, 0], prepend=stamps[:1, 0]) < -DAY / 2)
    parts, unit, steps = stamps[:, 1], SIXTIETHS, np.diff(seconds)
    if (steps == 1).any() and (steps == 0).any():
        after = np.diff(parts)
        # A program may drop rows, also where a second ends.
        turn = float(np.median(after[steps == 0])) - float(np.median(after[steps == 1]))
        unit = next(
            (rate for rate in TIMECODE_RATES if rate > np.floor(parts.max()) and abs(rate - turn) < 0.5), SIXTIETHS
        )
    if unit != SIXTIETHS:
        note(f"{path}: the last field of its timecodes counts frames, {unit} a second")
        parts = np.floor(parts)
    return np.asarray(seconds + parts / unit)


def gaze(names: Sequence[str], weights: Values) -> Array:
    """Rotations of the left and the right eye (T, 6) that weights of ``eyeLook`` shapes stand for.

    Each has yaw to the face's left, pitch down and roll, in radians about the axes of a right-handed face. The roll is
    the product of both, as in the app's recordings; without any of the shapes, an eye looks ahead.

    Args:
        names: K names of the weights.
        weights: (T, K).
    """

    def weight(name: str) -> Array:
        return weights[:, names.index(name)].astype(np.float64) if name in names else np.zeros(len(weights))

    columns: list[Array] = []
    for side, outwards in (("Left", 1.0), ("Right", -1.0)):
        yaw = outwards * LOOK["sideways"] * (weight(f"eyeLookOut{side}") - weight(f"eyeLookIn{side}"))
        pitch = LOOK["down"] * weight(f"eyeLookDown{side}") - LOOK["up"] * weight(f"eyeLookUp{side}")
        columns += [yaw, pitch, yaw * pitch]
    return np.stack(columns, axis=1)


def read_live_link(path: Path) -> ParameterClip:
    """Read a recording of Live Link Face.

    Columns are matched by name without regard to case; a recording without rotations of head and eyes has them declared
    as absent. Rotations are radians about the axes of a right-handed face that looks along +z: yaw to its left, pitch
    down. The rate comes from the timecode; where its steps are longer, rows were dropped,
    which :func:`~facediff.spaces.files.clips.even` interpolates.
    """
    space = layout("live_link")
    header, rows = read_columns(path, (TIMECODE, COUNT, *space.channels), remedy=REMEDY)
    if not {TIMECODE, COUNT} <= {*header}:
        raise FaceDiffError(f"{path}: has no columns {TIMECODE} and {COUNT}; {REMEDY}")
    lacking = [name for name in space.channels if name not in header]
    # Rotations are the one part that the app can leave out, and tongueOut came with a later version.
    if lacking and set(lacking) <= {*ROTATIONS, "tongueOut"}:
        header = [*header, *lacking]
    columns = columns_of(path, header, space)
    at_time = header.index(TIMECODE)
    times, numbers = list[tuple[int, float]](), list[int]()
    values = []
    for number, row in enumerate(rows, start=2):
        seen = any(row[2:])  # or the phone saw no face: the row has a timecode and nothing else
        if not seen and times:
            continue
        stamp = fields_of(row[at_time]) if len(row) > at_time else None
        if stamp is None:
            raise FaceDiffError(
                f"{path}: row {number} has the timecode {quoted(row[at_time : at_time + 1])}; expected "
                f"hours:minutes:seconds:sixtieths"
            )
        times.append(stamp)
        numbers.append(number)
        if seen:
            values.append(_numbers(path, number, [*row, *("0" for _ in lacking)], columns, len(header)))
    # The sound does not wait for a face: the first one stands at the take's beginning too.
    values[:0] = values[: len(times) - len(values)]
    clock = _clock(path, np.array(times).reshape(-1, 2))
    rate = rate_of(path, clock, [f"row {number}" for number in numbers])
    table = checked(path, np.array(values), rate)
    table[:, len(ARKIT) :] = mirrored(table[:, len(ARKIT) :])
    space = replace(space, absent=(*space.absent, *lacking))
    clip = ParameterClip(path.stem, table, space, rate, clock - clock[0], float(clock[0]), layout="live_link")
    return replace(clip, notes=(f"{clip.dropped} rows were dropped in the recording",)) if clip.dropped else clip


def mirrored(rotations: Values) -> Values:
    """Rotations (..., 9) of head and eyes from a right-handed face's axes to the app's mirrored frame.

    Radians both; the function is its own inverse.
    """
    return np.where(_MIRRORED, 0.0 - rotations, rotations)  # and not −0


def write_live_link(path: Path, clip: ParameterClip) -> None:
    """Write a recording in a space of ARKit's as Live Link Face does; channels that it lacks are 0."""
    with atomic(path) as temporary:
        write_table(temporary, [live_link_header(), *live_link_rows(clip)])


def live_link_rows(clip: ParameterClip) -> Iterator[list[str]]:
    """The rows of a recording's table, below :func:`live_link_header`; :func:`read_live_link` is the inverse."""
    values = permuted(clip.values, clip.space, layout("live_link"))[0]
    values[:, len(ARKIT) :] = mirrored(values[:, len(ARKIT) :])
    times = np.arange(len(values)) / clip.frame_rate if clip.times is None else clip.times
    count = str(len(ARKIT) + len(ROTATIONS))
    for seconds, row in zip(times, values, strict=True):
        yield [timecode(clip.start + float(seconds)), count, *map(shortest, row)]


PREFIX = "blendShapes."


def read_audio2face(path: Path) -> ParameterClip:
    """Read the weights that Audio2Face's service writes: ``timeCode`` in seconds and ``blendShapes.<name>``."""
    space = layout("audio2face")
    header, rows = read_columns(path, ("timeCode", *(PREFIX + name for name in space.channels)), remedy=REMEDY)
    shapes = [name.removeprefix(PREFIX) for name in header if name.startswith(PREFIX)]
    if "timeCode" not in header or not shapes:
        raise FaceDiffError(f"{path}: has no columns timeCode and {PREFIX}jawOpen …; {REMEDY}")
    lacking = [name for name in space.channels if name not in shapes]
    columns = columns_of(path, [*(name.removeprefix(PREFIX) for name in header), *lacking], space)
    wide = len(header) + len(lacking)
    cells = [
        _numbers(path, number, [*row, *("0" for _ in lacking)], [header.index("timeCode"), *columns], wide)
        for number, row in enumerate(rows, start=2)
    ]
    table = np.array(cells).reshape(len(cells), -1)
    clock = table[:, 0] if len(table) else np.zeros(0)
    rate = rate_of(path, clock, [f"row {number}" for number in range(2, len(clock) + 2)])
    values = with_apples_mouth(checked(path, table[:, 1:], rate), space.channels)
    space = replace(space, absent=tuple(lacking))
    return ParameterClip(path.stem, values, space, rate, clock - clock[0], float(clock[0]), layout="audio2face")


def _numbers(path: Path, number: int, row: list[str], columns: list[int], width: int) -> list[float]:
    """Cells of a row as numbers."""
    with damaged(f"{path}: row {number}", f"expected numbers in the {width} columns of the header"):
        if len(row) != width:
            raise ValueError(f"has {len(row)} cells")
        return [float(row[column]) for column in columns]
