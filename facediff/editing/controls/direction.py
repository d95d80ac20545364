"""Direction: keys over time for style, expressiveness, head, brows and the other controls of an animation.

From top to bottom: the channels of keys; :class:`Key` and :class:`Direction`; its files, JSON and CSV, which
docs/animation_controls.md describes; and the curves between keys.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import zip_longest
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, choices, damaged
from facediff.spaces.arkit import ARKIT, LEFT_AND_RIGHT
from facediff.utils import ranges
from facediff.utils.hints import Range, check_number, shown
from facediff.utils.limits import check_format, quoted
from facediff.utils.numerics import Array
from facediff.utils.paths import from_home
from facediff.utils.plain_files import json_text, load_json, parse_json, read_columns, write_json, write_rows
from facediff.utils.records import read_record

if TYPE_CHECKING:
    from facediff.animation import Animation


Interpolation = Literal["step", "linear", "smooth"]
"""Interpolation from a key to the next one: constant, a line, or a smooth curve."""

FORMAT, VERSION = "facediff direction", 1
METADATA = "direction"
"""Metadata key of an animation: the direction that it was made with."""
STEP_SECONDS = 0.2
"""Duration of a step in an animation, so that nothing pops; it ends at its key."""
TIMES = Range(0, 86_400)
SLOPES = Range(-1e6, 1e6)
MOST_KEYS = 100_000
INSTEAD_OF = ("acting", "blinks")
"""Options that keys can replace: a page turns their motion into keys."""
COLUMNS = ("time", "channel", "value", "interpolation", "slope")


@dataclass(frozen=True)
class Channel:
    """Something that can be directed over time."""

    range: Range | None  # the numbers that it takes; None for a text, as of ``--style``
    regions: bool = False  # whether it can be set for a region of the face alone, ``expressiveness.lips``
    parts: tuple[str, ...] = ()  # other names that may follow the dot
    in_model: bool = False  # whether it controls the model; else it changes finished motion


CHANNELS: dict[str, Channel] = {
    "style": Channel(None, in_model=True),
    # Of 1.x: they are read, and no longer followed.
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
ENDED = ("condition", "expressivity", "guidance")


def channel_of(name: str) -> Channel:
    """The channel that a key names.

    Example:
        >>> str(channel_of("expressiveness.lips").range)
        'from 0 to 4'
    """
    first, dot, part = name.partition(".")
    channel = CHANNELS.get(first)
    if channel and (part in channel.parts if channel.parts else not dot or (channel.regions and part)):
        return channel
    known = [known for known in CHANNELS if not CHANNELS[known].parts]
    known += [f"{known}.{part}" for known in CHANNELS for part in CHANNELS[known].parts]
    raise FaceDiffError(f"channel {shown(name)}: {choices(name, known)}")


@dataclass(frozen=True)
class Key:
    """The value of a channel at a time.

    Attributes:
        time: in seconds; frame i of an animation is at i / frame rate.
        channel: name of the channel.
        value: a number, or a text for ``style``.
        interpolation: how the channel goes on from here to its next key.
        slope: change a second at this key, for ``smooth`` curves of numbers; chosen so that the curve does not
            overshoot if None.

    Example:
        >>> Key(1.5, "expressiveness.upper_face", 1.4)
        Key(time=1.5, channel='expressiveness.upper_face', value=1.4, interpolation='smooth', slope=None)
    """

    time: Annotated[float, TIMES]
    channel: str
    value: float | str
    interpolation: Interpolation = "smooth"
    slope: Annotated[float, SLOPES] | None = None

    def __post_init__(self) -> None:
        ranges.check_options(self)
        limits = channel_of(self.channel).range
        if limits is not None:
            check_number(self.channel, "value", self.value, limits.least, limits.most)
        elif not isinstance(self.value, str) or not self.value.strip():
            raise FaceDiffError(f"value {shown(self.value)}: expected a text, as --{self.channel} takes it")
        # Numbers are floats from here on, also where a whole number or one of NumPy's was given.
        for name in ("time", "value", "slope"):
            number = getattr(self, name)
            if number is not None and not isinstance(number, str):
                object.__setattr__(self, name, float(number))


@dataclass(frozen=True)
class Direction:
    """Keys over time. Channels without a key stay as the options of ``facediff animate`` have them.

    Before its first key a channel has the first value, and after its last key the last one.

    Args:
        keys: in any order; no two of one channel at one time.
        source: its name in messages, such as the file that it was read from.
        instead_of: options of :data:`INSTEAD_OF` that the keys replace; both together would apply the motion twice.

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
        channel, times = max(Counter((key.channel, key.time) for key in ordered).items(), key=lambda pair: pair[1])
        if times > 1:
            raise FaceDiffError(f"{self.source}: time {channel[1]:g}: {channel[0]} has two keys; keep one of them")
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
        """The channels with this name before the dot."""
        return {channel: keys for channel, keys in self.channels.items() if channel.partition(".")[0] == name}

    def at(self, times: npt.ArrayLike) -> dict[str, Array]:
        """The channels' numbers (T,) at times (T,) in seconds; channels of texts are left out, see :meth:`shares`."""
        return {name: curve(keys, times) for name, keys in self.channels.items() if channel_of(name).range is not None}

    def shares(self, channel: str, times: npt.ArrayLike) -> dict[str, Array]:
        """How much each text of a channel counts (T,) at times (T,) in seconds; the shares of all of them sum to 1.

        A step changes from one text to the next, linear keys crossfade evenly, and smooth ones by 3t² − 2t³.
        """
        return text_shares(self.channels[channel], times)

    def refuse_both(self, name: str) -> None:
        """Refuse keys next to an option that sets the same channel, or that they replace."""
        fields = ["instead_of"] * (name in self.instead_of) + [f"channel {channel}" for channel in self.under(name)]
        if fields:
            raise FaceDiffError(f"{self.source}: {fields[0]}: the keys do the same as --{name}; give one of them")

    def refuse_model_channels(self, exported: bool = False) -> None:
        """Refuse channels of the model, such as the style, for a finished animation or an exported model."""
        channel = next((name for name in self.channels if channel_of(name).in_model), None)
        if channel is not None:
            reason = "the animation is finished; give the keys to `facediff animate --direction`"
            if exported:
                reason = "this one is exported; leave these keys out, or give the checkpoint (.ckpt of a training)"
            raise FaceDiffError(f"{self.source}: channel {channel}: needs the model itself, and {reason}")

    def without_model_channels(self) -> Direction | None:
        """The keys of channels that change finished motion; None if there are none."""
        keys = tuple(key for key in self.keys if not channel_of(key.channel).in_model)
        return replace(self, keys=keys) if keys else None

    def rows(self) -> list[dict[str, float | str]]:
        """The keys as the rows of a file."""
        return [{name: value for name, value in vars(key).items() if value is not None} for key in self.keys]

    def _content(self) -> dict[str, object]:
        """The content of a JSON file."""
        instead = {"instead_of": list(self.instead_of)} if self.instead_of else {}
        return {"format": FORMAT, "version": VERSION, **instead, "keys": self.rows()}

    def text(self) -> str:
        """The content of a JSON file, on one line; :meth:`parse` reads it."""
        return json_text(self.source, self._content(), indent=None)

    def save(self, path: str | Path) -> Path:
        """Write a .json file that :func:`read_direction` reads, or a .csv, which has no place for ``instead_of``."""
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".json", ".csv") or (suffix == ".csv" and self.instead_of):
            raise FaceDiffError(f"{path}: expected .json, or .csv for keys without instead_of")
        if suffix == ".json":
            write_json(path, self._content())
        else:
            empty = {"slope": ""} if any(key.slope is not None for key in self.keys) else {}
            write_rows(path, [{**empty, **row} if empty else row for row in self.rows()], line_end="\n")
        return path

    @classmethod
    def parse(cls, content: object, source: str) -> Direction:
        """A direction from the content of a JSON file, from its list of keys, or from the text of either."""
        if isinstance(content, str):
            content = parse_json(content, source)
        if isinstance(content, list):
            content = {"keys": content}
        record = read_record(_Content, content, source, remedy="give keys over time, .json or .csv")
        check_format(source, f"{record.format} {record.version}", f"{FORMAT} {VERSION}")
        keys = tuple(_read_keys(enumerate(record.keys, 1), source))
        return cls(keys, source, record.instead_of)


@dataclass(frozen=True)
class _Content:
    """A JSON file of keys."""

    keys: tuple[Any, ...]
    format: str = FORMAT
    version: int = VERSION
    instead_of: tuple[Literal["acting", "blinks"], ...] = ()


@dataclass(frozen=True)
class _Row:
    """A key in a file."""

    time: Any
    channel: str
    value: Any
    interpolation: Interpolation = "smooth"
    slope: Any = None


def _mood(shapes: Mapping[str, float], **values: float) -> tuple[Key, ...]:
    """Keys that hold from the beginning; a shape without a side stands for both."""
    both = {
        f"shape.{name}{side}": value
        for name, value in shapes.items()
        for side in (("Left", "Right") if name in LEFT_AND_RIGHT else ("",))
    }
    channels = {**{name.replace("__", "."): value for name, value in values.items()}, **both}
    return tuple(Key(0.0, name, value) for name, value in channels.items())


# Plain enough to be told apart in a face of a hundred pixels: the corners of the mouth and the brows say most.
MOODS = {
    "calm": _mood({"eyeBlink": 0.12, "mouthSmile": 0.12}, expressiveness=0.85),
    "lively": _mood({"mouthSmile": 0.25, "cheekSquint": 0.15}, expressiveness=1.25, brows=1.5),
    "happy": _mood(
        {"mouthSmile": 0.75, "cheekSquint": 0.7, "eyeSquint": 0.35, "mouthDimple": 0.2}, expressiveness=1.15, brows=1.0
    ),
    "sad": _mood(
        {"mouthFrown": 0.75, "browInnerUp": 0.9, "mouthShrugLower": 0.3, "eyeBlink": 0.22},
        expressiveness=0.75,
        head__pitch=6.0,
    ),
    "angry": _mood(
        {"browDown": 1.0, "noseSneer": 0.5, "eyeSquint": 0.4, "mouthFrown": 0.3, "mouthPress": 0.25},
        expressiveness=1.2,
        head__pitch=3.0,
    ),
    "surprised": _mood({"eyeWide": 1.0}, expressiveness=1.15, brows=6.0),
}
"""Keys by the name of a mood, which ``--direction`` takes in place of a file; they hold from beginning to end."""


def is_mood(path: str | Path) -> bool:
    """Whether it names a mood; a file or folder of that name comes first."""
    return str(path) in MOODS and not Path(path).exists()


def read_direction(path: str | Path) -> Direction:
    """A direction from a .json or .csv, from an animation (.npz) that was made with one, or by the name of a mood."""
    if is_mood(path):
        return Direction(MOODS[str(path)], str(path))
    path = Path(from_home(path))
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return Direction(tuple(_read_keys(_csv_rows(path), str(path))), str(path))
    if suffix == ".npz":
        from facediff.animation import read_archive

        return Direction.parse(read_archive(path).metadata.get(METADATA), str(path))
    content = load_json(path, remedy=f"expected keys over time, .json or .csv, or {', '.join(MOODS)}")
    return Direction.parse(content, str(path))


def direction_of(animation: Animation) -> Direction | None:
    """The keys that an animation was made with; None without any, or if its metadata hold something else."""
    try:
        return Direction.parse(animation.metadata.get(METADATA), animation.name)
    except FaceDiffError:
        return None


def _csv_rows(path: Path) -> Iterator[tuple[int, dict[str, str]]]:
    """Rows of a table as a spreadsheet counts them; empty cells are left out."""
    remedy = "expected a table with the columns time, channel, value and interpolation"
    header, rows = read_columns(path, COLUMNS, remedy=remedy)
    if not {"time", "channel", "value"} <= set(header) <= set(COLUMNS):
        raise FaceDiffError(f"{path}: row 1: has the columns {quoted(header)}; {remedy}")
    for number, row in enumerate(rows, 2):
        # A cell beyond the header gets an empty name, which is refused as an unknown field.
        cells = {name: cell for name, cell in zip_longest(header, row, fillvalue="") if cell}
        if cells:
            yield number, cells


def _read_keys(rows: Iterable[tuple[int, object]], source: str) -> Iterator[Key]:
    """Keys of rows with their numbers; texts that stand for numbers are read, since tables hold texts."""
    for number, row in rows:
        location = f"{source}: row {number}"
        with damaged(location, f"expected {', '.join(COLUMNS)}"):
            cells = vars(read_record(_Row, row, location))
            limits = channel_of(cells["channel"]).range
            if limits is None and cells["slope"] is not None:
                raise FaceDiffError(f"{location}: slope: expected none, since the channel takes texts")
            for name, bounds in (("time", TIMES), ("value", limits), ("slope", SLOPES)):
                if bounds is not None and (name, cells[name]) != ("slope", None):
                    cells[name] = check_number(location, name, cells[name], bounds.least, bounds.most, text=True)
            key = Key(**cells)
        yield key


# Curves.


def curve(keys: Sequence[Key], times: npt.ArrayLike, *, eased: bool = False) -> Array:
    """Numbers (T,) of a channel's keys, in their order, at times (T,) in seconds.

    ``step`` keeps a key's value until the next key. ``linear`` goes there on a line. ``smooth`` is the cubic Hermite
    curve between the values v₀, v₁ and the :func:`slopes` s₀, s₁ at both keys: with t from 0 to 1 over d seconds,
    (2t³ − 3t² + 1) v₀ + (t³ − 2t² + t) d s₀ + (3t² − 2t³) v₁ + (t³ − t²) d s₁.

    Args:
        keys: of one channel of numbers.
        times: seconds.
        eased: let a step take :data:`STEP_SECONDS`, or the time between its keys where that is shorter.
    """
    segments = _Segments(keys, times)
    index, following, t, kinds = segments.index, segments.following, segments.t, segments.kinds
    values = np.asarray([float(key.value) for key in keys], np.float64)
    first, last = values[index], values[following]
    values_at = np.array(first)
    linear = kinds == "linear"
    values_at[linear] = (first + t * (last - first))[linear]
    smooth = kinds == "smooth"
    if smooth.any():
        tangents = slopes(keys)
        t, span, first, last = t[smooth], segments.span[smooth], first[smooth], last[smooth]
        leaving, arriving = span * tangents[index[smooth]], span * tangents[following[smooth]]
        # Written as a distance from the first value, so that equal values give that value to the last bit.
        values_at[smooth] = (
            first + (3 * t**2 - 2 * t**3) * (last - first) + (t**3 - 2 * t**2 + t) * leaving + (t**3 - t**2) * arriving
        )
    if eased:
        step = kinds == "step"
        values_at[step] += ((values[following] - values[index]) * segments.step_share())[step]
    limits = channel_of(keys[0].channel).range
    return values_at if limits is None else np.clip(values_at, limits.least, limits.most)


def slopes(keys: Sequence[Key]) -> Array:
    """Change a second at each key (K,): as given, or else so that the curve does not overshoot.

    A slope that is not given is 0 at the first and the last key, and wherever the value turns round or stands still;
    elsewhere it is the slope of the line between the two neighbours, limited to three times the slope of either
    neighbouring line, which keeps a cubic curve between its keys' values (Fritsch and Carlson, "Monotone piecewise
    cubic interpolation", SIAM Journal on Numerical Analysis 17(2), 1980).
    """
    when = np.asarray([key.time for key in keys], np.float64)
    values = np.asarray([float(key.value) for key in keys], np.float64)
    key_slopes = np.zeros(len(keys))
    if len(keys) > 2:
        lines = np.diff(values) / np.diff(when)
        before, after = lines[:-1], lines[1:]
        middle = (values[2:] - values[:-2]) / (when[2:] - when[:-2])
        limit = 3 * np.minimum(np.abs(before), np.abs(after))
        key_slopes[1:-1] = np.where(before * after > 0, np.sign(middle) * np.minimum(np.abs(middle), limit), 0.0)
    for index, key in enumerate(keys):
        if key.slope is not None:
            key_slopes[index] = key.slope
    return key_slopes


def text_shares(keys: Sequence[Key], times: npt.ArrayLike, *, eased: bool = False) -> dict[str, Array]:
    """How much each text of a channel's keys counts (T,) at times (T,), see :meth:`Direction.shares`.

    Arguments as in :func:`curve`.
    """
    segments = _Segments(keys, times)
    t, kinds = segments.t, segments.kinds
    steps = segments.step_share() if eased else np.zeros(len(t))
    share = np.where(kinds == "step", steps, np.where(kinds == "linear", t, 3 * t**2 - 2 * t**3))
    texts = list(dict.fromkeys(str(key.value) for key in keys))
    number = np.array([texts.index(str(key.value)) for key in keys])
    shares = {}
    for index, text in enumerate(texts):
        leaving, arriving = number[segments.index] == index, number[segments.following] == index
        shares[text] = np.where(leaving & arriving, 1.0, np.where(leaving, 1 - share, np.where(arriving, share, 0.0)))
    return shares


class _Segments:
    """The segments between keys in which times (T,) lie: the key before, the key after, and the share t between."""

    def __init__(self, keys: Sequence[Key], times: npt.ArrayLike) -> None:
        key_times = np.asarray([key.time for key in keys], np.float64)
        self.times = np.atleast_1d(np.asarray(times, np.float64))
        # Frames are at i / frame rate, and a key there may have been written with fewer digits.
        self.index = np.clip(np.searchsorted(key_times, self.times + 1e-9, side="right") - 1, 0, len(keys) - 1)
        self.following = np.minimum(self.index + 1, len(keys) - 1)
        self.start, self.end = key_times[self.index], key_times[self.following]
        # Past the last key both are the same, and the division must not give NaN.
        self.span = np.maximum(self.end - self.start, 1e-12)
        self.t = np.clip((self.times - self.start) / self.span, 0.0, 1.0)
        self.kinds = np.array([key.interpolation for key in keys])[self.index]

    def step_share(self) -> Array:
        """How far a step to the following key has come (T,): 3t² − 2t³ of the seconds before it."""
        duration = np.maximum(np.minimum(self.end - self.start, STEP_SECONDS), 1e-12)
        t = np.clip(1 - (self.end - self.times) / duration, 0.0, 1.0)
        # Before the first key and after the last one, nothing follows.
        return np.where((self.times < self.start) | (self.following == self.index), 0.0, t * t * (3 - 2 * t))
