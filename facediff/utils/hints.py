"""Values and type hints: whether a value fits a hint, the hint in words, and plain data converted by it.

Options of the command line, of dataclasses, functions and constructors, and the arguments in a checkpoint pass here,
each at the door where it enters. Ranges of numbers are part of the type: ``Annotated[int, Range(1, 8)]``.
"""

from __future__ import annotations

import collections.abc
import functools
import inspect
import math
import re
import sys
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from collections.abc import Set as AbstractSet
from contextlib import suppress
from dataclasses import dataclass
from enum import Enum
from numbers import Integral, Real
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin

from facediff.errors import ArgumentError, FaceDiffError, OptionError
from facediff.utils.limits import WORDS_SHOWN, quoted

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Python's own int() and float() also take underscores, blanks and the digits of every script.
_WHOLE = re.compile(r"[+-]?[0-9]{1,30}", re.ASCII)
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?(inf|infinity|nan)", re.ASCII)

LONGEST_TEXT = 4096
"""Characters of a text, as long as a path may be."""

LONGEST_NAME = 200
"""Characters of the name of a speaker, a clip or a class."""

RESERVED = {"class_path", "init_args", "dict_kwargs", "_class_path", "_instantiator", "__path__"}
"""Keys by which Lightning and jsonargparse recognise something to import or to open."""


@dataclass(frozen=True, repr=False)
class Range:
    """The numbers that an argument or an option takes: ``Annotated[float, Range(0, 1)]``. NaN and infinity never.

    Attributes:
        above, below: whether ``least`` and ``most`` themselves are left out.
        items: for lists, in which every item must lie in the range, the fewest and the most items.
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
        ends = (number == self.least and self.above) or (number == self.most and self.below)
        return self.least <= number <= self.most and not ends and -math.inf < number < math.inf

    def __str__(self) -> str:
        """The range in words; none if it has no ends."""
        low, high = _end(self.least), _end(self.most)
        if low and high and not self.above:
            return f"from {low} to {'below ' if self.below else ''}{high}"
        ends = [f"above {low}" if self.above else f"at least {low}"] if low else []
        ends += [f"below {high}" if self.below else f"at most {high}"] if high else []
        text = " and ".join(ends)
        return f"of {text}" if text.startswith("at") else text

    __repr__ = __str__  # the help of Lightning's commands shows type hints as Python does

    def numbers(self, *, whole: bool = False) -> str:
        """The range in words: ``a whole number from 1 to 8``."""
        bounded = math.isfinite(self.least) and math.isfinite(self.most)
        noun = "a whole number" if whole else "a number" if bounded else "a finite number"
        return f"{noun} {self}".strip()

    def read(self, name: str, text: str, *, whole: bool = False) -> float:
        """The number of an option (in braces) or a field that a text spells; an error names it."""
        try:
            number: float = read(Annotated[int if whole else float, self], text)
        except ValueError as error:
            raise OptionError.naming(f"{name} {shown(text)}: expected {error}") from error
        return number


def _end(number: float) -> str:
    """A number without an exponent where that is readable; nothing for an end that is not there."""
    if math.isinf(number):
        return ""
    return str(int(number)) if number == int(number) else f"{number:g}"


def shown(value: object) -> str:
    """A wrong value as errors repeat it: on one line, not too long, and visible even if it is empty."""
    plain = isinstance(value, str) and value.isprintable() and value.strip() == value and 0 < len(value) <= WORDS_SHOWN
    return str(value) if plain else quoted(value)


def extras_of(hint: Any) -> Iterator[Any]:  # noqa: ANN401 - a type hint
    """Everything that stands as an annotation in a type hint, outermost first."""
    yield from getattr(hint, "__metadata__", ())
    for part in get_args(hint):
        if not isinstance(part, Range):
            yield from extras_of(part)


def range_of(hint: Any) -> Range | None:  # noqa: ANN401 - a type hint
    """The range that a type hint declares, anywhere in it: also in ``Annotated[…] | None`` or a list."""
    declared: Range | None = next((extra for extra in extras_of(hint) if isinstance(extra, Range)), None)
    return declared


def fits(hint: Any, value: object, limits: Range = Range(), *, stored: bool = False) -> bool:  # noqa: ANN401, B008
    """Whether a value is one of a type hint; types that are not plain, such as our classes, take everything.

    Args:
        hint: the type hint.
        value: the value.
        limits: of numbers, where the hint states none.
        stored: whether a file states the value. Then it must be plain data that cannot be read as anything but itself:
            Lightning and jsonargparse import class paths, open configs and resolve ``${…}`` wherever a value lets them.
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        limits = next((extra for extra in inner[1:] if isinstance(extra, Range)), limits)
        return fits(inner[0], value, limits, stored=stored)
    if origin in (Union, types.UnionType):
        return any(fits(part, value, limits, stored=stored) for part in inner)
    if origin is Literal:
        return any(type(value) is type(choice) and value == choice for choice in inner)
    if hint is None or hint is types.NoneType:
        return value is None
    if hint is bool:
        return isinstance(value, bool)
    if hint in (int, float):
        return isinstance(value, Integral if hint is int else Real) and value in limits
    if hint in (str, Path):
        return isinstance(value, str) and is_plain_text(value) if stored else isinstance(value, str | PathLike)
    kind = origin or hint
    if kind in (list, tuple, set, frozenset, collections.abc.Sequence, collections.abc.Collection, AbstractSet):
        return _items_fit(kind, inner, value, limits, stored=stored)
    if isinstance(kind, type) and issubclass(kind, Mapping):
        return _entries_fit(inner or (str, Any), value, stored=stored)
    if not stored:
        return not getattr(hint, "_is_protocol", False) or callable(value)  # of what makes a component
    if isinstance(hint, type) and issubclass(hint, Enum):
        return fits(int | str, value, stored=True)
    return is_inert(value) if hint in (Any, object) or isinstance(hint, TypeVar) else False


def _items_fit(kind: Any, inner: tuple[Any, ...], value: Any, limits: Range, *, stored: bool) -> bool:  # noqa: ANN401
    """Whether a value is a list, a tuple or a set of items that fit."""
    sized = isinstance(value, list | tuple) or (not stored and hasattr(value, "__iter__") and hasattr(value, "__len__"))
    if not sized or isinstance(value, str | bytes | Mapping):
        return False
    if kind is tuple and inner and inner[-1] is not Ellipsis and stored:
        return len(value) == len(inner) and all(
            fits(part, item, stored=True) for part, item in zip(inner, value, strict=True)
        )
    hint = inner[0] if inner else Any
    return limits.items[0] <= len(value) <= limits.items[1] and all(
        fits(hint, item, limits, stored=stored) for item in value
    )


def _entries_fit(inner: tuple[Any, ...], value: object, *, stored: bool) -> bool:
    """Whether a value is a mapping, a stored one of plain names to values that fit."""
    if not stored:
        return isinstance(value, Mapping)
    return (
        isinstance(value, dict)
        and not RESERVED & value.keys()
        and all(isinstance(name, str) and is_plain_text(name) for name in value)
        and all(fits(inner[1], part, stored=True) for part in value.values())
    )


def mismatch(hint: Any, value: object) -> str | None:  # noqa: ANN401 - a type hint
    """The words for a type hint that a value does not fit; None if it fits."""
    return None if fits(hint, value) else describe(hint)


def describe(hint: Any, limits: Range = Range()) -> str:  # noqa: ANN401, B008 - a type hint; a frozen dataclass
    """A type hint in words."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return describe(inner[0], next((extra for extra in inner[1:] if isinstance(extra, Range)), limits))
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(describe(part, limits) for part in inner))
    if origin is Literal:
        return f"one of {', '.join(map(str, inner))}"
    if hint in (int, float):
        return limits.numbers(whole=hint is int)
    if origin in (list, tuple, set, frozenset, collections.abc.Sequence):
        items = f", each {describe(inner[0], limits)}" if inner else ""
        return f"a list of {limits.items[0]} to {limits.items[1]} items{items}"
    if isinstance(origin or hint, type) and issubclass(origin or hint, Mapping):
        return "a mapping"
    if getattr(hint, "_is_protocol", False):
        return "a component's class"
    phrases = {bool: "true or false", str: "text", Path: "a path", types.NoneType: "null", None: "null"}
    return phrases.get(hint, "a plain value" if hint is Any else str(getattr(hint, "__name__", hint)))


def convert(hint: Any, value: Any) -> Any:  # noqa: ANN401 - a type hint and its value
    """Plain data that fits a hint, in its form; undoes :func:`facediff.hyperparameters.plain`."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return convert(inner[0], value)
    if origin in (Union, types.UnionType):
        return convert(next(part for part in inner if fits(part, value, stored=True)), value)
    if isinstance(value, list | tuple) and (origin or hint) in (tuple, set, frozenset):
        return (origin or hint)(value)
    if isinstance(hint, type) and issubclass(hint, Path | Enum):
        return hint(value)
    return float(value) if hint is float else value


def read(hint: Any, word: str) -> Any:  # noqa: ANN401 - a type hint and its value
    """A word of the command line as a value of a hint; numbers in ASCII digits, without underscores or blanks."""
    options = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    for option in options:
        bare = get_args(option)[0] if get_origin(option) is Annotated else option
        value: Any = word
        if get_origin(bare) is Literal:
            value = next((choice for choice in get_args(bare) if str(choice) == word), None)
        elif bare is bool:
            value = {"true": True, "false": False}.get(word.lower())
        elif bare in (int, float):
            value = bare(word) if (_WHOLE if bare is int else _DECIMAL).fullmatch(word) else None
        elif bare is types.NoneType:
            if word.lower() == "none":
                return None
            continue
        if value is not None and fits(option, value):
            return value
    raise ValueError(describe(hint))


def check_number(
    source: object,
    name: str,
    value: object,
    low: float = -math.inf,
    high: float = math.inf,
    *,
    whole: bool = False,
    text: bool = False,
    remedy: str = "",
) -> float:
    """The number ``name`` of a file (``source``) if it lies in a range and is ``whole`` where asked for.

    As ``text``, as tables hold it, it is read; ``remedy`` ends the message.
    """
    number = value
    if text and isinstance(value, str):
        number = float(value) if _DECIMAL.fullmatch(value.strip()) else value
    with suppress(OverflowError):  # a whole number that no float holds
        if number in Range(low, high) and (not whole or number == int(number)):  # type: ignore[call-overload]
            return float(number)  # type: ignore[arg-type]
    advice = f"; {remedy}" if remedy else ""
    raise FaceDiffError(
        f"{source}: {name} is {quoted(value)}; expected {Range(low, high).numbers(whole=whole)}{advice}"
    )


# Texts.


def is_plain_text(text: str) -> bool:
    """Whether a text neither refers to a resolver or to another machine nor holds control characters."""
    refers = "${" in text or "://" in text or text.startswith(("\\\\", "//"))
    return len(text) <= LONGEST_TEXT and text.isprintable() and not refers


def is_inert(value: object) -> bool:
    """Whether a value means itself even where a parser may take it for YAML."""
    if isinstance(value, dict):
        return fits(dict[str, Any], value, stored=True)
    if isinstance(value, list | tuple):
        return all(map(is_inert, value))
    if isinstance(value, str):
        special = re.search(r"[{}\[\]&*!|>%@`#,\"'?]|:\s|:$|^[-?:]\s|^-+$", value)
        return special is None and is_plain_text(value)
    return value is None or isinstance(value, bool | int | float)


def is_path(value: object) -> bool:
    """Whether a value can be the import path of a class."""
    short = isinstance(value, str) and len(value) <= 2 * LONGEST_NAME and "." in value
    return short and all(part.isidentifier() for part in str(value).split("."))


def is_name(text: object) -> bool:
    """Whether a text can name a speaker or a clip in tables and file names."""
    if not isinstance(text, str) or not 0 < len(text) <= LONGEST_NAME or text in (".", ".."):
        return False
    return text.isprintable() and not set(text) & set("/\\")


# Doors: the fields of a dataclass, the arguments of a function and of a constructor.


@functools.cache
def hints_of(owner: Any) -> dict[str, Any]:  # noqa: ANN401 - a function or a class
    """The type hints of a function, or of a class's fields, without those that only a type checker can resolve."""
    try:
        return typing.get_type_hints(owner, include_extras=True)
    except (NameError, TypeError):
        pass
    module = vars(sys.modules[owner.__module__])
    hints: dict[str, Any] = {}
    for name, hint in owner.__annotations__.items():
        with suppress(NameError, TypeError):
            stub = SimpleNamespace(__annotations__={name: hint})
            hints |= typing.get_type_hints(stub, module, include_extras=True)
    return hints


def check_options(options: Any) -> None:  # noqa: ANN401 - an instance of a dataclass
    """Refuse options, the fields of a dataclass, that do not fit their type hints; for ``__post_init__``.

    None is allowed.
    """
    owner: Any = type(options)
    for name, hint in hints_of(owner).items():
        value = getattr(options, name)
        if value is not None and (expected := mismatch(hint, value)) is not None:
            problem = "out of range" if isinstance(value, Real) and range_of(hint) is not None else "not valid"
            raise OptionError(name, f"{problem}; expected {expected}", shown(value))


def checked(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorator that refuses arguments outside the ranges of their type hints. None is allowed."""
    signature = inspect.signature(function)

    @functools.wraps(function)
    def call(*values: Arguments.args, **options: Arguments.kwargs) -> Result:
        for name, value in signature.bind(*values, **options).arguments.items():
            hint = hints_of(function).get(name)
            if value is not None and range_of(hint) is not None and (expected := mismatch(hint, value)) is not None:
                raise FaceDiffError(f"{function.__name__}.{name} {shown(value)}: out of range; expected {expected}")
        return function(*values, **options)

    return call


def checks_arguments(init: Callable[..., None], path: str = "", *, sizes: str = "") -> Callable[..., None]:
    """Let a constructor refuse values that do not fit its type hints, and report its other errors alike.

    Args:
        init: the constructor.
        path: prefix of the argument's name in an option; the object's ``options_path``, or its class's name, if empty.
        sizes: the same for arguments without a default, which are options of the owner.
    """
    signature = inspect.signature(init)

    @functools.wraps(init)
    def wrapped(self: Any, *values: Any, **options: Any) -> None:  # noqa: ANN401
        owner = path or getattr(self, "options_path", "") or type(self).__name__

        def located(name: str) -> str:
            parameter = signature.parameters.get(name)
            of_owner = parameter is None or parameter.default is inspect.Parameter.empty
            return f"{sizes if sizes and of_owner else owner}.{name}"

        arguments = signature.bind_partial(self, *values, **options).arguments
        arguments = {name: value for name, value in arguments.items() if name in hints_of(init)}
        for name, value in arguments.items():
            if (expected := mismatch(hints_of(init)[name], value)) is not None:
                raise ArgumentError({located(name): value}, f"expected {expected}", located=True)
        try:
            init(self, *values, **options)
        except ArgumentError as error:
            raise error if error.located else error.at(located) from error.__cause__
        except (ValueError, RuntimeError, ArithmeticError, MemoryError) as error:
            reason = next(iter(str(error).strip().splitlines()), type(error).__name__)
            arguments = {
                located(name): value for name, value in arguments.items() if isinstance(value, int | float | str)
            }
            raise ArgumentError(
                arguments or {owner: type(self).__name__},
                f"{type(self).__name__} cannot be made ({reason})",
                located=True,
            ) from error

    return wrapped


def options_of(owner: type) -> dict[str, inspect.Parameter]:
    """The parameters of a constructor with their type hints, those that ``**options`` hands on to a base included."""
    parameters: dict[str, inspect.Parameter] = {}
    for cls in owner.__mro__:
        init = vars(cls).get("__init__")
        if not inspect.isfunction(init):
            continue
        declared = list(inspect.signature(init).parameters.values())[1:]
        arguments = [p for p in declared if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
        hints = hints_of(init)
        parameters = {p.name: p.replace(annotation=hints.get(p.name, Any)) for p in arguments} | parameters
        if all(p.kind is not p.VAR_KEYWORD for p in declared):
            break
    return parameters


def defaults(component: type) -> dict[str, Any]:
    """A class's options with their defaults; sizes that a model gives it have none and are left out."""
    return {p.name: p.default for p in options_of(component).values() if p.default is not p.empty}
