"""Which numbers an option takes: declared next to its type, and checked where the number enters.

The same declaration serves the command line, which checks what is typed and says the range in its help, and the
dataclasses by which Python calls the same functions, which check their fields when they are made.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
import re
import sys
import typing
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from numbers import Integral, Real
from types import SimpleNamespace
from typing import Annotated, Any, ParamSpec, TypeVar, get_args

from facediff.errors import FaceDiffError
from facediff.utils.limits import FRAME_RATES, WORDS_SHOWN, quoted

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Python's own int() and float() also take underscores, blanks and the digits of every script.
_WHOLE = re.compile(r"[+-]?[0-9]{1,30}", re.ASCII)
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity|nan)", re.ASCII)


@dataclass(frozen=True)
class Range:
    """The numbers that an option or a field takes, as in ``Annotated[float, Range(0, 1)]``; NaN and infinity never.

    Attributes:
        least: the smallest number, which is included unless ``above`` is set.
        most: the largest number, which is included unless ``below`` is set.
        above: whether ``least`` itself is left out.
        below: whether ``most`` itself is left out.

    Example:
        >>> Range(0, 1, below=True).check("share", 0.5)
        0.5
        >>> print(Range(0, 1, below=True))
        from 0 to below 1
    """

    least: float
    most: float
    above: bool = False
    below: bool = False

    def __contains__(self, number: object) -> bool:
        """Whether a number lies in the range."""
        if isinstance(number, bool) or not isinstance(number, Real):
            return False
        number = typing.cast(float, number)
        low = number > self.least if self.above else number >= self.least
        return low and (number < self.most if self.below else number <= self.most)

    def __str__(self) -> str:
        """The range in words."""
        low, high = _plain(self.least), _plain(self.most)
        if self.above:
            return f"above {low} and {'below' if self.below else 'at most'} {high}"
        return f"from {low} to {'below ' if self.below else ''}{high}"

    def check(self, name: str, number: Any, *, whole: bool = False) -> Any:  # noqa: ANN401 - a number, given back as it is
        """Give a number back if it lies in the range.

        Args:
            name: the option or field, for the message.
            number: the number.
            whole: whether it must be an integer.

        Raises:
            FaceDiffError: naming the option and the range.
        """
        if number not in self or (whole and not isinstance(number, Integral)):
            raise FaceDiffError(f"{name} {shown(number)}: out of range; expected {noun(whole)} {self}")
        return number

    def read(self, name: str, text: str, *, whole: bool = False) -> float:
        """The number that a text spells, in ASCII digits and without underscores or blanks.

        Raises:
            FaceDiffError: if it spells none, or one outside the range.
        """
        if not (_WHOLE if whole else _DECIMAL).fullmatch(text):
            raise FaceDiffError(f"{name} {shown(text)}: not valid; expected {noun(whole)} {self}")
        number = int(text) if whole else float(text)
        if number not in self:
            raise FaceDiffError(f"{name} {shown(text)}: out of range; expected {noun(whole)} {self}")
        return number


def noun(whole: bool) -> str:
    """What kind of number is expected, in words."""
    return "a whole number" if whole else "a number"


def shown(value: object) -> str:
    """A wrong value as errors repeat it: on one line, not too long, and visible even if it is empty."""
    plain = isinstance(value, str) and value.isprintable() and value.strip() == value and 0 < len(value) <= WORDS_SHOWN
    return str(value) if plain else quoted(value)


def _plain(number: float) -> str:
    """A number without an exponent where that is readable."""
    return str(int(number)) if number == int(number) else f"{number:g}"


def range_of(hint: Any) -> Range | None:  # noqa: ANN401 - a type hint
    """The range that a type hint declares, anywhere in it: also in ``Annotated[…] | None`` or a list."""
    found: Range | None = next((extra for extra in extras_of(hint) if isinstance(extra, Range)), None)
    return found


def extras_of(hint: Any) -> Iterator[Any]:  # noqa: ANN401
    """Everything that stands as an annotation in a type hint, outermost first."""
    yield from getattr(hint, "__metadata__", ())
    for part in get_args(hint):
        if not isinstance(part, Range):
            yield from extras_of(part)


def check_fields(made: Any) -> None:  # noqa: ANN401 - an instance of a dataclass
    """Refuse a dataclass's fields outside the ranges of their type hints; for ``__post_init__``. None is allowed.

    Raises:
        FaceDiffError: naming the class, the field and the range.
    """
    _check(type(made), {field.name: getattr(made, field.name) for field in dataclasses.fields(made)})


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
        allowed, value = range_of(hint), values.get(name)
        if allowed is None:
            continue
        whole = int in (hint, *_parts(hint))
        for number in value if isinstance(value, list | tuple) else [value]:
            if number is None:
                continue
            allowed.check(f"{owner.__name__}.{name}", number, whole=whole)


@functools.cache
def _hints(owner: Any) -> dict[str, Any]:  # noqa: ANN401
    module = vars(sys.modules[owner.__module__])
    found: dict[str, Any] = {}
    for name, hint in owner.__annotations__.items():
        with suppress(NameError):  # imported for type checkers only, so it is no number
            alone = SimpleNamespace(__annotations__={name: hint})
            found |= typing.get_type_hints(alone, module, include_extras=True)
    return found


def _parts(hint: Any) -> Iterator[Any]:  # noqa: ANN401
    for part in get_args(hint):
        yield part
        yield from _parts(part)


# The numbers that several commands and functions take. Upper ends are far above what is useful, and low enough that
# nothing overflows and no machine is filled by a slip of the finger.

BlinkRate = Annotated[float, Range(1, 40)]
Bound = Annotated[float, Range(-1000, 1000)]
ClipLength = Annotated[float, Range(1, 600)]
Duration = Annotated[float, Range(0.001, 604_800)]
"""Seconds that something lasts; a week at most."""
Epochs = Annotated[int, Range(1, 100_000)]
Factor = Annotated[float, Range(1e-9, 1e9)]
"""What lengths are multiplied by, or the end of a scale."""
FrameRate = Annotated[float, Range(*FRAME_RATES)]
GazeAngle = Annotated[float, Range(0, 20, above=True)]
LearningRate = Annotated[float, Range(0, 1, above=True)]
Level = Annotated[float, Range(0.01, 0.9999)]
Megabytes = Annotated[float, Range(0.001, 100_000)]
Millimetres = Annotated[float, Range(1e-6, 100)]
PageWidth = Annotated[float, Range(30, 1000)]
Pixels = Annotated[int, Range(16, 4096)]
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
Tolerance = Annotated[float, Range(1e-15, 1)]
Vertices = Annotated[int, Range(1, 2_000_000)]
Window = Annotated[float, Range(0.01, 600)]
Workers = Annotated[int, Range(1, 1024)]
