"""Which numbers an option takes: declared next to its type, and checked where the number enters.

One declaration serves all: the command line, which checks what is typed and says the range in its help; the dataclasses
and functions by which Python does the same; the constructors of models, components, corpora and callbacks (see
:func:`facediff.registry.checks_arguments`); and the trainer's options.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import functools
import inspect
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from numbers import Integral, Real
from os import PathLike
from types import SimpleNamespace
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from facediff.errors import FaceDiffError, OptionError
from facediff.utils.limits import FRAME_RATES, WORDS_SHOWN, quoted

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Python's own int() and float() also take underscores, blanks and the digits of every script.
_WHOLE = re.compile(r"[+-]?[0-9]{1,30}", re.ASCII)
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity|nan)", re.ASCII)


@dataclass(frozen=True, repr=False)
class Range:
    """The numbers that an argument or an option takes: ``Annotated[float, Range(0, 1)]``. NaN and infinity never.

    Attributes:
        least: the smallest number, which is included unless ``above`` is set.
        most: the largest number, which is included unless ``below`` is set.
        above: whether ``least`` itself is left out.
        below: whether ``most`` itself is left out.
        items: for lists, whose every item must lie in the range, the fewest and the most items.

    Example:
        >>> 0.5 in Range(0, 1, below=True)
        True
        >>> print(Range(0, 1, below=True))
        from 0 to below 1
    """

    least: float = -math.inf
    most: float = math.inf
    above: bool = False
    below: bool = False
    items: tuple[int, int] = (0, 1000)

    def __contains__(self, number: object) -> bool:
        """Whether a number lies in the range."""
        if isinstance(number, bool) or not isinstance(number, Real):
            return False
        number = typing.cast(float, number)
        low = number > self.least if self.above else number >= self.least
        high = number < self.most if self.below else number <= self.most
        return low and high and -math.inf < number < math.inf

    def __str__(self) -> str:
        """The range in words; none if it has no ends."""
        low, high = _plain(self.least), _plain(self.most)
        if low and high and not self.above:
            return f"from {low} to {'below ' if self.below else ''}{high}"
        ends = [f"above {low}" if self.above else f"at least {low}"] if low else []
        ends += [f"below {high}" if self.below else f"at most {high}"] if high else []
        text = " and ".join(ends)
        return f"of {text}" if text.startswith("at") else text

    __repr__ = __str__  # the help of Lightning's commands shows type hints as Python does

    def numbers(self, *, whole: bool = False) -> str:
        """What is expected, in words: ``a whole number from 1 to 8``."""
        bounded = math.isfinite(self.least) and math.isfinite(self.most)
        noun = "a whole number" if whole else "a number" if bounded else "a finite number"
        return f"{noun} {self}".strip()

    def read(self, name: str, text: str, *, whole: bool = False) -> float:
        """The number that a text spells, in ASCII digits and without underscores or blanks.

        Raises:
            FaceDiffError: if it spells none, or one outside the range.
        """
        if not (_WHOLE if whole else _DECIMAL).fullmatch(text):
            raise FaceDiffError(f"{name} {shown(text)}: not valid; expected {self.numbers(whole=whole)}")
        number = int(text) if whole else float(text)
        if number not in self:
            raise FaceDiffError(f"{name} {shown(text)}: out of range; expected {self.numbers(whole=whole)}")
        return number


def shown(value: object) -> str:
    """A wrong value as errors repeat it: on one line, not too long, and visible even if it is empty."""
    plain = isinstance(value, str) and value.isprintable() and value.strip() == value and 0 < len(value) <= WORDS_SHOWN
    return str(value) if plain else quoted(value)


def _plain(number: float) -> str:
    """A number without an exponent where that is readable; nothing for an end that is not there."""
    if math.isinf(number):
        return ""
    return str(int(number)) if number == int(number) else f"{number:g}"


def range_of(hint: Any) -> Range | None:  # noqa: ANN401 - a type hint
    """The range that a type hint declares, anywhere in it: also in ``Annotated[…] | None`` or a list."""
    declared: Range | None = next((extra for extra in extras_of(hint) if isinstance(extra, Range)), None)
    return declared


def extras_of(hint: Any) -> Iterator[Any]:  # noqa: ANN401
    """Everything that stands as an annotation in a type hint, outermost first."""
    yield from getattr(hint, "__metadata__", ())
    for part in get_args(hint):
        if not isinstance(part, Range):
            yield from extras_of(part)


def mismatch(hint: Any, value: Any, limits: Range = Range()) -> str | None:  # noqa: ANN401, B008 - a frozen dataclass
    """What was expected of a value that does not fit its type hint; None if it fits, or if the hint is no plain type.

    >>> mismatch(Annotated[int, Range(1, 8)], 9)
    'a whole number from 1 to 8'
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return mismatch(inner[0], value, next((extra for extra in inner[1:] if isinstance(extra, Range)), limits))
    if origin in (Union, types.UnionType):
        expected = [mismatch(part, value, limits) for part in inner]
        return None if None in expected else " or ".join(word for word in expected if word)
    if origin is Literal:
        fits = any(type(value) is type(choice) and value == choice for choice in inner)
        return None if fits else f"one of {', '.join(map(str, inner))}"
    if hint in (int, float):
        kind = Integral if hint is int else Real
        fits = isinstance(value, kind) and value in limits
        return None if fits else limits.numbers(whole=hint is int)
    if origin in (list, tuple, collections.abc.Sequence):
        fits = hasattr(value, "__iter__") and hasattr(value, "__len__") and not isinstance(value, str | bytes | Mapping)
        expected = [mismatch(inner[0], item, limits) for item in value] if fits and inner else []
        fits = fits and limits.items[0] <= len(value) <= limits.items[1]
        wrong = [word for word in expected if word]
        return (
            None
            if fits and not wrong
            else f"a list of {limits.items[0]} to {limits.items[1]} items" + (f", each {wrong[0]}" if wrong else "")
        )
    if origin is dict:
        return None if isinstance(value, Mapping) else "a mapping"
    if getattr(hint, "_is_protocol", False):  # of what makes a component
        return None if callable(value) else "a component's class"
    plain_types = {bool: (bool,), str: (str, PathLike), types.NoneType: (types.NoneType,)}
    expectations = {bool: "true or false", str: "text", types.NoneType: "null"}
    return None if hint not in expectations or isinstance(value, plain_types[hint]) else expectations[hint]


def check_fields(instance: Any) -> None:  # noqa: ANN401 - an instance of a dataclass
    """Refuse a dataclass's fields outside the ranges of their type hints; for ``__post_init__``. None is allowed."""
    _check(type(instance), {field.name: getattr(instance, field.name) for field in dataclasses.fields(instance)})


def check_options(options: Any) -> None:  # noqa: ANN401 - an instance of a dataclass
    """Refuse options, the fields of a dataclass, that do not fit their type hints. None is allowed.

    Raises:
        OptionError: naming the option and the range.
    """
    owner: Any = type(options)
    for name, hint in _all_hints(owner).items():
        value = getattr(options, name)
        if value is not None and (expected := mismatch(hint, value)) is not None:
            problem = "out of range" if isinstance(value, Real) and range_of(hint) is not None else "not valid"
            raise OptionError(name, f"{problem}; expected {expected}", shown(value))


@functools.cache
def _all_hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a class
    """The type hints of a class and of those that it extends."""
    return typing.get_type_hints(owner, include_extras=True)


def checked(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorator that refuses arguments outside the ranges of their type hints. None is allowed.

    Example:
        >>> @checked
        ... def half(share: Annotated[float, Range(0, 1)]) -> float:
        ...     return share / 2
        >>> half(2.0)
        Traceback (most recent call last):
        facediff.errors.FaceDiffError: half.share 2.0: out of range; expected a number from 0 to 1
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*arguments: Arguments.args, **named: Arguments.kwargs) -> Result:
        _check(function, signature.bind(*arguments, **named).arguments)
        return function(*arguments, **named)

    return call


def _check(owner: Any, values: Mapping[str, Any]) -> None:  # noqa: ANN401 - a class or a function
    for name, hint in _hints(owner).items():
        value = values.get(name)
        if value is None or range_of(hint) is None:
            continue
        expected = mismatch(hint, value)
        if expected is not None:
            raise FaceDiffError(f"{owner.__name__}.{name} {shown(value)}: out of range; expected {expected}")


@functools.cache
def _hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401
    module = vars(sys.modules[owner.__module__])
    hints: dict[str, Any] = {}
    for name, hint in owner.__annotations__.items():
        with suppress(NameError):  # imported for type checkers only, so it is no number
            alone = SimpleNamespace(__annotations__={name: hint})
            hints |= typing.get_type_hints(alone, module, include_extras=True)
    return hints


# The numbers that several commands and functions take. Upper ends are far above what is useful, and low enough that
# nothing overflows and no machine is filled by a slip of the finger.

BlinkRate = Annotated[float, Range(1, 40)]
USUAL_BLINKS = 17.0
"""Blinks a minute where no number is given: those of somebody at rest."""
Bound = Annotated[float, Range(-1000, 1000)]
ChunkLength = Annotated[float, Range(0.01, 60)]
ClipLength = Annotated[float, Range(1, 600)]
Correlation = Annotated[float, Range(0, 1)]
Duration = Annotated[float, Range(0.001, 604_800)]
"""Seconds that something lasts; a week at most."""
Epochs = Annotated[int, Range(1, 100_000)]
EXPRESSIVITY = Range(0, 2)
Expressivity = Annotated[float, EXPRESSIVITY]
"""From the mean prediction (0) to a sample (1) and beyond."""
Factor = Annotated[float, Range(1e-9, 1e9)]
"""What lengths are multiplied by, or the end of a scale."""
FrameRate = Annotated[float, Range(*FRAME_RATES)]
GUIDANCE_SCALE = Range(0, 10)
GuidanceScale = Annotated[float, GUIDANCE_SCALE]
GazeAngle = Annotated[float, Range(0, 20, above=True)]
USUAL_GAZE = 4.0
"""Degrees where no number is given."""
Interpolation = Annotated[float, Range(0, 1, above=True)]
KeyTolerance = Annotated[float, Range(0, 1)]
LearningRate = Annotated[float, Range(0, 1, above=True)]
Level = Annotated[float, Range(0.01, 0.9999)]
Megabytes = Annotated[float, Range(0.001, 100_000)]
Millimetres = Annotated[float, Range(1e-6, 100)]
Semitones = Annotated[float, Range(-12, 12)]
TakeOffset = Annotated[float, Range(-3600, 3600)]
PageWidth = Annotated[float, Range(30, 1000)]
Pixels = Annotated[int, Range(16, 4096)]
PerRater = Annotated[int, Range(1, 1000)]
"""Answers of one rater to one comparison of a user study, or comparisons in it."""
Port = Annotated[int, Range(0, 65_535)]
Power = Annotated[float, Range(0.5, 0.999)]
Preference = Annotated[float, Range(0.005, 0.5)]
"""How far the share of answers that prefer something lies above one half."""
Raters = Annotated[int, Range(1, 1_000_000)]
Resamples = Annotated[int, Range(0, 1_000_000)]
Resolution = Annotated[int, Range(50, 1200)]
SampleRate = Annotated[int, Range(1000, 384_000)]
Samples = Annotated[int, Range(1, 1000)]
Seconds = Annotated[float, Range(0, 86_400)]
Seed = Annotated[int, Range(0, 2**62 - 1)]
"""The generators of random numbers take 64 bits, and the numbers of clips and samples are added to the seed."""
Smoothing = Annotated[float, Range(0, 1, below=True)]
Steps = Annotated[int, Range(1, 10_000)]
Strength = Annotated[float, Range(0, 1e6)]
Stride = Annotated[int, Range(1, 1000)]
SwayAngle = Annotated[float, Range(0, 15, above=True)]
USUAL_SWAY = 2.0
"""Degrees where no number is given."""
Threads = Annotated[int, Range(0, 1024)]
Tolerance = Annotated[float, Range(1e-15, 1)]
USUAL_LOW_LATENCY_STEPS = 1500
"""Steps in which an audio encoder is distilled for low latency."""

USUAL_VOICE_STEPS = 600
"""Training steps in which an audio encoder learns other voices where no number is given."""
Vertices = Annotated[int, Range(1, 2_000_000)]
Dims = Annotated[int, Range(1, 3)]
Window = Annotated[float, Range(0.01, 600)]
Workers = Annotated[int, Range(1, 1024)]
