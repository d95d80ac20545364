"""Direction: keys over time for style, expressiveness, head, brows and whatever else an animation is controlled by.

From top to bottom: the channels that keys can be set for; :class:`Key`, and :class:`Direction`, whose curves are
evaluated at any times; and its files, JSON and CSV, which docs/animation_controls.md describes.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, choices
from facediff.spaces.arkit import ARKIT
from facediff.utils import ranges
from facediff.utils.hints import Range, read, shown
from facediff.utils.limits import FRAME_RATES, quoted
from facediff.utils.plain_files import json_text, load_json, parse_json, read_table, write_json, write_rows

if TYPE_CHECKING:
    from facediff.animation import Animation

Array = npt.NDArray[np.float64]

Interpolation = Literal["step", "linear", "smooth"]
"""How a channel goes from a key to the next one: it keeps the value until then, or follows a line or a smooth curve."""

FORMAT, VERSION = "facediff direction", 1
METADATA = "direction"
"""Metadata key of an animation: the direction that it was made with."""
STEP_SECONDS = 0.2
"""What a step takes in an animation, so that nothing pops; it arrives at its key."""
TIMES = Range(0, 86_400)
SLOPES = Range(-1e6, 1e6)
MOST_KEYS = 100_000
INSTEAD_OF = ("acting", "blinks")
"""Options whose work keys can stand for: a page turns it into keys."""
COLUMNS = ("time", "frame", "channel", "value", "interpolation", "slope")
_TIMECODE = re.compile(r"([0-9]{1,2}):([0-9]{2}):([0-9]{2})([:;.,])([0-9]{1,3})", re.ASCII)


@dataclass(frozen=True)
class Channel:
    """Something that can be directed over time.

    Attributes:
        range: the numbers that it takes; None for a text, such as that of ``--style``.
        regions: whether it can be set for a region of the face alone, ``expressiveness.lips``.
        parts: other names that may follow the dot.
        in_model: whether it decides what the model generates; else it changes finished motion.
    """

    range: Range | None
    regions: bool = False
    parts: tuple[str, ...] = ()
    in_model: bool = False


CHANNELS: dict[str, Channel] = {
    "style": Channel(None, in_model=True),
    "condition": Channel(None, in_model=True),
    "expressivity": Channel(ranges.EXPRESSIVITY, regions=True, in_model=True),
    "guidance": Channel(ranges.GUIDANCE_SCALE, parts=("speech", "identity", "style"), in_model=True),
    "expressiveness": Channel(Range(0, 4), regions=True),
    "acting": Channel(Range(0, 2)),
    "shape": Channel(Range(-1, 1), parts=ARKIT),  # weights that are added to the motion
    "brows": Channel(Range(-5, 8)),  # millimetres
    "lids": Channel(Range(0, 1)),
    "blinks": Channel(Range(0, 40)),  # a minute
    "gaze": Channel(Range(0, 20)),  # degrees
    "sway": Channel(Range(0, 15)),  # degrees
    "head": Channel(Range(-30, 30), parts=("pitch", "yaw", "roll")),  # degrees
}
"""All channels, by the name in front of a dot."""


def channel_of(name: str) -> Channel:
    """The channel that a key names.

    Example:
        >>> str(channel_of("expressiveness.lips").range)
        'from 0 to 4'
    """
    first, dot, part = name.partition(".")
    channel = CHANNELS.get(first)
    known_names = [channel_name for channel_name in CHANNELS if not CHANNELS[channel_name].parts]
    known_names += [f"{channel_name}.{part}" for channel_name in CHANNELS for part in CHANNELS[channel_name].parts]
    fits = channel is not None and (part in channel.parts if channel.parts else not dot or (channel.regions and part))
    if channel is None or not fits:
        raise FaceDiffError(f"channel {shown(name)}: {choices(name, known_names)}")
    return channel


@dataclass(frozen=True)
class Key:
    """The value of a channel at a time.

    Attributes:
        time: in seconds; frame i of an animation is at i / frame rate.
        channel: name of the channel.
        value: a number, or a text for ``style`` and ``condition``.
        interpolation: how the channel goes on from here to its next key.
        slope: change a second at this key, for ``smooth`` curves of numbers; chosen so that the curve does not
            overshoot if None.

    Example:
        >>> Key(1.5, "expressiveness.upper_face", 1.4)
        Key(time=1.5, channel='expressiveness.upper_face', value=1.4, interpolation='smooth', slope=None)
    """

    time: float
    channel: str
    value: float | str
    interpolation: Interpolation = "smooth"
    slope: float | None = None

    def __post_init__(self) -> None:
        _number("time", self.time, TIMES)
        limits = channel_of(str(self.channel)).range
        if limits is not None:
            _number("value", self.value, limits)
        elif not isinstance(self.value, str) or not self.value.strip():
            raise FaceDiffError(f"value {shown(self.value)}: expected a text, as --{self.channel} takes it")
        if self.interpolation not in get_args(Interpolation):
            remedy = choices(str(self.interpolation), get_args(Interpolation))
            raise FaceDiffError(f"interpolation {shown(self.interpolation)}: {remedy}")
        if self.slope is not None:
            _number("slope", self.slope, SLOPES)
        # Numbers are floats from here on, also where a whole number or one of NumPy's was given.
        for name in ("time", "value", "slope"):
            number = getattr(self, name)
            if number is not None and not isinstance(number, str):
                object.__setattr__(self, name, float(number))


def _number(name: str, value: object, limits: Range) -> None:
    if value not in limits:
        raise FaceDiffError(f"{name} {shown(value)}: expected {limits.numbers()}")


@dataclass(frozen=True)
class Direction:
    """Keys over time. Channels without a key stay as the options of ``facediff animate`` have them.

    Before its first key a channel has that key's value, and after its last one that one's.

    Args:
        keys: in any order; no two of one channel at one time.
        source: what messages call it, such as the file that it was read from.
        instead_of: options of :data:`INSTEAD_OF` whose work the keys stand for; with them it would be done twice.

    Example:
        >>> direction = Direction([Key(0, "expressiveness", 1.0), Key(2, "expressiveness", 2.0)])
        >>> direction.at([0, 1, 2])["expressiveness"]
        array([1. , 1.5, 2. ])
    """

    keys: Sequence[Key]
    source: str = "direction"
    instead_of: Sequence[str] = ()

    def __post_init__(self) -> None:
        if not 0 < len(self.keys) <= MOST_KEYS:
            raise FaceDiffError(f"{self.source}: holds {len(self.keys)} keys; expected 1 to {MOST_KEYS}")
        ordered = sorted(self.keys, key=lambda key: key.time)
        taken: set[tuple[str, float]] = set()
        for key in ordered:
            if (key.channel, key.time) in taken:
                raise FaceDiffError(
                    f"{self.source}: time {key.time:g}: {key.channel} has two keys then; keep one of them"
                )
            taken.add((key.channel, key.time))
        object.__setattr__(self, "keys", tuple(ordered))
        object.__setattr__(self, "instead_of", tuple(dict.fromkeys(self.instead_of)))

    @cached_property
    def channels(self) -> dict[str, tuple[Key, ...]]:
        """The keys of each channel in their order in time; channels in the order of their first keys."""
        by_channel: dict[str, list[Key]] = {}
        for key in self.keys:
            by_channel.setdefault(key.channel, []).append(key)
        return {name: tuple(keys) for name, keys in by_channel.items()}

    def under(self, name: str) -> dict[str, tuple[Key, ...]]:
        """The channels of one name, whatever follows the dot."""
        return {channel: keys for channel, keys in self.channels.items() if channel.partition(".")[0] == name}

    def constant(self, channel: str) -> float | str | None:
        """The one value of a channel that never changes; None if it does, or has no keys."""
        keys = self.channels.get(channel, ())
        values = {key.value for key in keys}
        return next(iter(values)) if len(values) == 1 and not any(key.slope for key in keys) else None

    def at(self, times: npt.ArrayLike) -> dict[str, Array]:
        """The channels' numbers (T,) at times (T,) in seconds; channels of texts are left out, see :meth:`shares`."""
        return {name: curve(keys, times) for name, keys in self.channels.items() if channel_of(name).range is not None}

    def shares(self, channel: str, times: npt.ArrayLike) -> dict[str, Array]:
        """How much each text of a channel counts (T,) at times (T,) in seconds; the shares of all of them sum to 1.

        A step changes from one text to the next, linear keys crossfade evenly, and smooth ones by 3t² − 2t³.
        """
        return text_shares(self.channels[channel], times)

    def refuse_both(self, name: str) -> None:
        """Refuse keys of what an option of this name sets from beginning to end, or that stand for what it does."""
        if name in self.instead_of:
            raise FaceDiffError(f"{self.source}: instead_of: the keys do what --{name} did; omit --{name}")
        for channel in self.under(name):
            raise FaceDiffError(f"{self.source}: channel {channel}: --{name} says the same; give one of them")

    def refuse_model_channels(self, exported: bool = False) -> None:
        """Refuse keys of what only a model can follow, such as the style, and of those only one with PyTorch."""
        for channel in self.channels:
            if channel_of(channel).in_model:
                reason = (
                    "needs the model, and the animation is finished; give the keys to `facediff animate --direction`"
                )
                if exported:
                    reason = (
                        "needs a checkpoint (.ckpt of a training), and this model is an exported one; leave these keys "
                        "out, or give the checkpoint"
                    )
                raise FaceDiffError(f"{self.source}: channel {channel}: {reason}")

    def without_model_channels(self) -> Direction | None:
        """The keys of what changes finished motion; None if there are none."""
        left = tuple(key for key in self.keys if not channel_of(key.channel).in_model)
        return replace(self, keys=left) if left else None

    def rows(self) -> list[dict[str, float | str]]:
        """The keys as the rows of a file."""
        return [
            {
                "time": key.time,
                "channel": key.channel,
                "value": key.value,
                "interpolation": key.interpolation,
                **({} if key.slope is None else {"slope": key.slope}),
            }
            for key in self.keys
        ]

    def _content(self) -> dict[str, object]:
        """What a JSON file holds."""
        instead = {"instead_of": list(self.instead_of)} if self.instead_of else {}
        return {"format": FORMAT, "version": VERSION, **instead, "keys": self.rows()}

    def text(self) -> str:
        """The content of a JSON file, on one line; :meth:`parse` reads it."""
        return json_text(self.source, self._content(), indent=None)

    def save(self, path: str | Path) -> Path:
        """Write a .json file that :func:`read_direction` reads, or a .csv, which has no place for ``instead_of``."""
        path = Path(path)
        if path.suffix.lower() == ".json":
            write_json(path, self._content())
        elif path.suffix.lower() == ".csv":
            if self.instead_of:
                raise FaceDiffError(f"{path}: instead_of: a table has no place for it; choose .json")
            empty = {"slope": ""} if any(key.slope is not None for key in self.keys) else {}
            write_rows(path, [{**empty, **row} if empty else row for row in self.rows()], line_end="\n")
        else:
            raise FaceDiffError(f'{path}: unknown suffix "{path.suffix}"; expected .json or .csv')
        return path

    @classmethod
    def parse(cls, content: object, source: str, frame_rate: float | None = None) -> Direction:
        """A direction from the content of a JSON file, or from its list of keys.

        Args:
            content: the object, a list of rows, or the text of either.
            source: what messages call it.
            frame_rate: of frames and timecodes, where the content does not say it.
        """
        if isinstance(content, str):
            content = parse_json(content, source)
        if isinstance(content, list):
            content = {"keys": content}
        if not isinstance(content, dict) or not isinstance(content.get("keys"), list):
            raise FaceDiffError(f'{source}: keys: expected an object with a list of rows called "keys"')
        stated = (content.get("format", FORMAT), content.get("version", VERSION))
        unknown = sorted(content.keys() - {"format", "version", "frame_rate", "instead_of", "keys"})
        if unknown or stated != (FORMAT, VERSION):
            raise FaceDiffError(
                f"{source}: is {' '.join(map(shown, stated))} with {quoted(unknown)}; expected {FORMAT} {VERSION} with "
                f"format, version, frame_rate, instead_of and keys alone"
            )
        frame_rate = content.get("frame_rate", frame_rate)
        if frame_rate is not None and frame_rate not in Range(*FRAME_RATES):
            raise FaceDiffError(
                f"{source}: frame_rate {shown(frame_rate)}: expected {Range(*FRAME_RATES).numbers()} (frames a second)"
            )
        instead_of = content.get("instead_of", [])
        if not isinstance(instead_of, list) or not all(name in INSTEAD_OF for name in instead_of):
            raise FaceDiffError(f"{source}: instead_of {shown(instead_of)}: expected a list of {', '.join(INSTEAD_OF)}")
        keys = tuple(_read_keys(enumerate(content["keys"], 1), source, frame_rate))
        return cls(keys, source, instead_of)


def _mood(**values: float) -> tuple[Key, ...]:
    return tuple(Key(0.0, name.replace("__", "."), value) for name, value in values.items())


MOODS = {
    "calm": _mood(expressiveness=0.85, shape__eyeBlinkLeft=0.08, shape__eyeBlinkRight=0.08),
    "lively": _mood(expressiveness=1.25, brows=1.0, shape__mouthSmileLeft=0.1, shape__mouthSmileRight=0.1),
    "happy": _mood(
        expressiveness=1.1,
        brows=0.5,
        shape__mouthSmileLeft=0.35,
        shape__mouthSmileRight=0.35,
        shape__cheekSquintLeft=0.3,
        shape__cheekSquintRight=0.3,
    ),
    "sad": _mood(
        expressiveness=0.75,
        head__pitch=4.0,
        shape__mouthFrownLeft=0.35,
        shape__mouthFrownRight=0.35,
        shape__browInnerUp=0.45,
        shape__eyeBlinkLeft=0.12,
        shape__eyeBlinkRight=0.12,
    ),
    "angry": _mood(
        expressiveness=1.2,
        head__pitch=2.0,
        shape__browDownLeft=0.6,
        shape__browDownRight=0.6,
        shape__noseSneerLeft=0.2,
        shape__noseSneerRight=0.2,
    ),
    "surprised": _mood(expressiveness=1.15, brows=4.0, shape__eyeWideLeft=0.5, shape__eyeWideRight=0.5),
}
"""Keys by the name of a mood, which ``--direction`` takes in place of a file; they hold from beginning to end."""


def is_mood(path: str | Path) -> bool:
    """Whether it names a mood; a file or folder of that name comes first."""
    return str(path) in MOODS and not Path(path).exists()


def read_direction(path: str | Path, frame_rate: float | None = None) -> Direction:
    """A direction from a file.

    Args:
        path: .json or .csv, an animation (.npz) that was made with a direction, or the name of a mood.
        frame_rate: of frames and timecodes, where the file does not say it.
    """
    if is_mood(path):
        return Direction(MOODS[str(path)], str(path))
    path = Path(path)
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such file; expected keys over time, .json or .csv, or {', '.join(MOODS)}")
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return Direction(tuple(_read_keys(_csv_rows(path), str(path), frame_rate)), str(path))
    if suffix == ".npz":
        from facediff.animation import read_archive

        text = read_archive(path).metadata.get(METADATA)
        if text is None:
            raise FaceDiffError(f"{path}: was made without a direction; give keys over time, .json or .csv")
        return Direction.parse(text, str(path), frame_rate)
    return Direction.parse(load_json(path), str(path), frame_rate)


def direction_of(animation: Animation) -> Direction | None:
    """The keys that an animation was made with; None without any, or if its metadata hold something else."""
    try:
        return Direction.parse(animation.metadata.get(METADATA), animation.name, animation.frame_rate)
    except FaceDiffError:
        return None


def direction_file(folder: Path, recording: Path) -> Path | None:
    """The file of a folder that has the keys for a recording: ``NAME.direction.json``, ``NAME.json`` or ``.csv``."""
    for name in (f"{recording.stem}.direction", recording.stem):
        for suffix in (".json", ".csv"):
            if (path := folder / f"{name}{suffix}").is_file():
                return path
    return None


def _csv_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a table with their numbers as a spreadsheet counts them; empty cells are left out."""
    remedy = "expected a table with the columns time (or frame), channel, value and interpolation"
    rows = read_table(path, remedy=remedy)
    header = [name.strip().lower() for name in next(rows, [])]
    if not {"channel", "value"} <= set(header) <= set(COLUMNS) or len(set(header)) < len(header):
        raise FaceDiffError(f"{path}: row 1: has the columns {quoted(header)}; {remedy}, each once")
    for number, row in enumerate(rows, 2):
        if len(row) > len(header) and any(cell.strip() for cell in row[len(header) :]):
            raise FaceDiffError(f"{path}: row {number}: has {len(row)} cells for {len(header)} columns; quote commas")
        cells = {name: cell.strip() for name, cell in zip(header, row, strict=False)}
        if any(cells.values()):
            yield number, {name: cell for name, cell in cells.items() if cell}


def _read_keys(rows: Iterable[tuple[int, object]], source: str, frame_rate: float | None) -> Iterator[Key]:
    """Keys of rows with their numbers; texts that stand for numbers are read."""
    for number, row in rows:
        try:
            yield _read_key(row, frame_rate)
        except FaceDiffError as error:
            raise FaceDiffError(f"{source}: row {number}: {error}") from error


def _read_key(row: object, frame_rate: float | None) -> Key:
    fits = isinstance(row, Mapping) and {"channel", "value"} <= row.keys() <= set(COLUMNS)
    if not isinstance(row, Mapping) or not fits or ("time" in row) == ("frame" in row):
        raise FaceDiffError(f"is {shown(row)}; expected {', '.join(COLUMNS)}, with either a time or a frame")
    channel, value, slope = row["channel"], row["value"], row.get("slope")
    if isinstance(channel, str):
        limits = channel_of(channel).range
        if limits is not None and isinstance(value, str):  # a cell of a table
            value = _read(limits, "value", value)
        if limits is None and slope is not None:
            raise FaceDiffError(f"slope {shown(slope)}: {channel} holds texts, which have no slope; omit it")
    if isinstance(slope, str):
        slope = _read(SLOPES, "slope", slope)
    time = _time(row["time"], frame_rate) if "time" in row else _seconds("frame", row["frame"], frame_rate)
    return Key(time, cast(str, channel), value, row.get("interpolation", "smooth"), slope)


def _time(time: object, frame_rate: float | None) -> float:
    """Seconds, from a number of them or a timecode: ``00:00:01:12`` (frames), or ``00:00:01.480``."""
    if not isinstance(time, str):
        _number("time", time, TIMES)
        return cast(float, time)
    if not (timecode := _TIMECODE.fullmatch(time)):
        try:
            return _read(TIMES, "time", time)
        except FaceDiffError as error:
            raise FaceDiffError(f"{error}, or a timecode such as 00:00:01:12") from error
    hours, minutes, seconds = (int(number) for number in timecode.groups()[:3])
    whole = 3600 * hours + 60 * minutes + seconds
    if timecode[4] in ".,":
        return whole + int(timecode[5]) / 10 ** len(timecode[5])
    if frame_rate is not None and int(timecode[5]) >= math.ceil(frame_rate):
        raise FaceDiffError(f"time {time}: has frame {timecode[5]} of {frame_rate:g} a second; expected a smaller one")
    return whole + _seconds("time", int(timecode[5]), frame_rate)


def _read(limits: Range, name: str, text: str) -> float:
    """The number in a cell of a table."""
    try:
        return cast(float, read(Annotated[float, limits], text.strip()))
    except ValueError as error:
        raise FaceDiffError(f"{name} {shown(text)}: expected {error}") from error


def _seconds(name: str, frame: object, frame_rate: float | None) -> float:
    limits = Range(0, TIMES.most * FRAME_RATES[1])
    if isinstance(frame, str):
        frame = _read(limits, name, frame)
    _number(name, frame, limits)
    if frame_rate is None:
        raise FaceDiffError(f'{name} {shown(frame)}: counts frames; say how many there are a second, "frame_rate"')
    return cast(float, frame) / frame_rate


# Curves.


def curve(keys: Sequence[Key], times: npt.ArrayLike, *, eased: bool = False) -> Array:
    """Numbers (T,) of a channel's keys, in their order, at times (T,) in seconds.

    ``step`` keeps a key's value until the next key. ``linear`` goes there on a line. ``smooth`` is the cubic Hermite
    curve between the values v₀, v₁ and the slopes s₀, s₁ at both keys: with t from 0 to 1 over d seconds,
    (2t³ − 3t² + 1) v₀ + (t³ − 2t² + t) d s₀ + (3t² − 2t³) v₁ + (t³ − t²) d s₁. Slopes that are not given are those of
    :func:`slopes`.

    Args:
        keys: of one channel of numbers.
        times: seconds.
        eased: let a step take :data:`STEP_SECONDS`, or the time between its keys where that is shorter.
    """
    when = np.asarray([key.time for key in keys], np.float64)
    values = np.asarray([float(key.value) for key in keys], np.float64)
    place, now = _places(when, times)
    following = np.minimum(place + 1, len(keys) - 1)
    first, last = values[place], values[following]
    # Past the last key both are the same, and the division must not give NaN.
    span = np.maximum(when[following] - when[place], 1e-12)
    t = np.clip((now - when[place]) / span, 0.0, 1.0)
    kinds = np.array([key.interpolation for key in keys])[place]
    values_at = np.array(first)
    linear = kinds == "linear"
    values_at[linear] = (first + t * (last - first))[linear]
    smooth = kinds == "smooth"
    if smooth.any():
        tangents = slopes(keys)
        t, span, first, last = t[smooth], span[smooth], first[smooth], last[smooth]
        leaving, arriving = span * tangents[place[smooth]], span * tangents[following[smooth]]
        # Written as a distance from the first value, so that equal values give that value to the last bit.
        values_at[smooth] = (
            first + (3 * t**2 - 2 * t**3) * (last - first) + (t**3 - 2 * t**2 + t) * leaving + (t**3 - t**2) * arriving
        )
    if eased:
        step = kinds == "step"
        values_at[step] += ((values[following] - values[place]) * _arriving(now, when, place, following))[step]
    limits = channel_of(keys[0].channel).range
    return values_at if limits is None else np.clip(values_at, limits.least, limits.most)


def slopes(keys: Sequence[Key]) -> Array:
    """Change a second at each key (K,): as given, or else so that the curve does not overshoot.

    A slope that is not given is 0 at the first and the last key, and wherever the value turns round or stands still;
    elsewhere it is that of the line between the two neighbours, and at most three times that of either neighbouring
    line, which keeps a cubic curve between its keys' values (Fritsch and Carlson, "Monotone piecewise cubic
    interpolation", SIAM Journal on Numerical Analysis 17(2), 1980).
    """
    when = np.asarray([key.time for key in keys], np.float64)
    values = np.asarray([float(key.value) for key in keys], np.float64)
    key_slopes = np.zeros(len(keys))
    if len(keys) > 2:
        lines = np.diff(values) / np.diff(when)
        before, after = lines[:-1], lines[1:]
        middle = (values[2:] - values[:-2]) / (when[2:] - when[:-2])
        most = 3 * np.minimum(np.abs(before), np.abs(after))
        key_slopes[1:-1] = np.where(before * after > 0, np.sign(middle) * np.minimum(np.abs(middle), most), 0.0)
    own_slopes = [(index, key.slope) for index, key in enumerate(keys) if key.slope is not None]
    for index, slope in own_slopes:
        key_slopes[index] = slope
    return key_slopes


def text_shares(keys: Sequence[Key], times: npt.ArrayLike, *, eased: bool = False) -> dict[str, Array]:
    """How much each text of a channel's keys counts (T,) at times (T,), see :meth:`Direction.shares`.

    The arguments are those of :func:`curve`.
    """
    when = np.asarray([key.time for key in keys], np.float64)
    place, now = _places(when, times)
    following = np.minimum(place + 1, len(keys) - 1)
    t = np.clip((now - when[place]) / np.maximum(when[following] - when[place], 1e-12), 0.0, 1.0)
    kinds = np.array([key.interpolation for key in keys])[place]
    steps = _arriving(now, when, place, following) if eased else np.zeros(len(now))
    share = np.where(kinds == "step", steps, np.where(kinds == "linear", t, 3 * t**2 - 2 * t**3))
    texts = list(dict.fromkeys(str(key.value) for key in keys))
    number = np.array([texts.index(str(key.value)) for key in keys])
    shares = {text: np.zeros(len(now)) for text in texts}
    for index, text in enumerate(texts):
        leaving, arriving = number[place] == index, number[following] == index
        shares[text] = np.where(leaving & arriving, 1.0, np.where(leaving, 1 - share, np.where(arriving, share, 0.0)))
    return shares


def _places(when: Array, times: npt.ArrayLike) -> tuple[npt.NDArray[np.int64], Array]:
    """The key (T,) that is in force at each time, and the times (T,)."""
    now = np.atleast_1d(np.asarray(times, np.float64))
    # Frames are at i / frame rate, and a key there may have been written with fewer digits.
    place = np.clip(np.searchsorted(when, now + 1e-9, side="right") - 1, 0, len(when) - 1)
    return place, now


def _arriving(now: Array, when: Array, place: npt.NDArray[np.int64], following: npt.NDArray[np.int64]) -> Array:
    """How far a step to the following key has come (T,): 3t² − 2t³ of the seconds before it."""
    span = np.minimum(when[following] - when[place], STEP_SECONDS)
    t = np.clip(1 - (when[following] - now) / np.maximum(span, 1e-12), 0.0, 1.0)
    # Before the first key and after the last one, nothing follows.
    return np.where((now < when[place]) | (following == place), 0.0, t * t * (3 - 2 * t))
