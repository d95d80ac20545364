"""Plain data of a file (JSON or YAML) as a dataclass: the one check of plans, studies, answers and results.

Type hints state the content of a file: ``Annotated[int, Range(0, 9)]``, ``Annotated[str, Text("[a-z]+")]``, tuples,
mappings and further dataclasses. A value that does not fit is refused in a sentence that names file and field.
"""

from __future__ import annotations

import functools
import re
import types
import typing
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from facediff.errors import FaceDiffError, choices
from facediff.utils.hints import mismatch
from facediff.utils.limits import quoted
from facediff.utils.ranges import Range

Record = TypeVar("Record")

DERIVED = {"derived": True}
"""Metadata of a field that no file states, since it follows from others or from where the record stands."""


@dataclass(frozen=True)
class Text:
    """The texts that a field takes: ``Annotated[str, Text("[a-z]+", "small letters")]``.

    Attributes:
        pattern: that the whole text matches.
        expected: words for the pattern in errors.
        longest: characters at most.
    """

    pattern: str = r"(?s).*"
    expected: str = ""
    longest: int = 20_000

    def __contains__(self, text: object) -> bool:
        return len(str(text)) <= self.longest and re.fullmatch(self.pattern, str(text)) is not None

    def __str__(self) -> str:
        return self.expected or f"a text like {self.pattern}"


@dataclass(frozen=True)
class Items:
    """How many different entries a list has: ``Annotated[tuple[str, ...], Items(1)]``."""

    least: int = 0
    most: int = 1_000_000

    def __contains__(self, items: Sequence[object]) -> bool:
        return self.least <= len(items) <= self.most and len({*items}) == len(items)

    def __str__(self) -> str:
        return f"a list of {self.least} or more, each once" if self.most >= 10_000 else f"{self.least} to {self.most}"


def read_record(
    kind: type[Record], content: object, source: object, *, remedy: str = "", strict: bool = True, name: str = ""
) -> Record:
    """A dataclass from plain data; a field without a default has to be there, and null stands for the default.

    Args:
        kind: the dataclass.
        content: plain data from a file.
        source: the file, for messages.
        remedy: how messages end.
        strict: whether fields that the dataclass does not have are refused; they are passed over otherwise.
        name: of the field of the file that holds the content; empty for all of it.
    """
    record: Record = _Reader(source, remedy, strict).read(kind, content, name)
    return record


@dataclass(frozen=True)
class _Reader:
    source: object
    remedy: str
    strict: bool

    def read(self, hint: Any, value: Any, name: str) -> Any:  # noqa: ANN401 - a type hint and plain data
        """A value as its hint asks for it; refuses one that does not fit."""
        origin, inner = get_origin(hint), get_args(hint)
        if origin is Annotated:
            (limits, *_) = inner[1:]
            if isinstance(limits, Range):
                return self.leaf(hint, value, name)
            result = self.read(inner[0], value, name)
            return result if result in limits else self.refuse(name, value, str(limits))
        if origin in (Union, types.UnionType) and types.NoneType in inner:
            (hint,) = (part for part in inner if part is not types.NoneType)
            return None if value is None else self.read(hint, value, name)
        if is_dataclass(hint):
            return self.record(hint, value, name)
        if origin in (tuple, Sequence) and isinstance(value, list):
            return self.items(inner, value, name)
        if origin is Mapping and isinstance(value, dict):
            return {
                self.read(inner[0], key, f"{name}: a key"): self.read(inner[1], entry, f"{name}.{key}")
                for key, entry in value.items()
            }
        if origin in (tuple, Sequence, Mapping):
            return self.refuse(name, value, "fields with values" if origin is Mapping else "a list")
        return value if hint is Any else self.leaf(hint, value, name)

    def leaf(self, hint: Any, value: Any, name: str) -> Any:  # noqa: ANN401
        """A number, a text, a truth value, or one of several."""
        expected = mismatch(str if hint is Path else hint, value)
        if expected is not None:
            return self.refuse(name, value, expected)
        return Path(value) if hint is Path else value

    def items(self, inner: tuple[Any, ...], value: list[Any], name: str) -> tuple[Any, ...]:
        """A tuple of a list: of equal items, or of as many as the hint has."""
        if len(inner) == 1 or inner[-1] is Ellipsis:
            return tuple(self.read(inner[0], item, f"{name}[{index}]") for index, item in enumerate(value))
        if len(inner) != len(value):
            return self.refuse(name, value, f"a list of {len(inner)}")
        return tuple(map(self.read, inner, value, [f"{name}[{index}]" for index in range(len(value))]))

    def record(self, kind: Any, content: Any, name: str) -> Any:  # noqa: ANN401 - a dataclass
        """A dataclass from a mapping."""
        content = {} if content is None else content
        if not isinstance(content, dict):
            return self.refuse(name or "the content", content, "fields with values")
        fields_by_name = _fields(kind)
        prefix = f"{name}." if name else ""
        if self.strict and (unknown := next((key for key in content if key not in fields_by_name), None)) is not None:
            label = quoted(unknown) if not isinstance(unknown, str) else f'"{unknown}"'
            where = f"{self.source}: {name}" if name else f"{self.source}"
            raise FaceDiffError(f"{where}: has no field {label}: {choices(str(unknown), fields_by_name)}")
        values = {}
        for key, (field, hint) in fields_by_name.items():
            value = content.get(key)
            if value is None and (field.default is not MISSING or field.default_factory is not MISSING):
                continue
            values[key] = self.read(hint, value, f"{prefix}{key}")
        return kind(**values)

    def refuse(self, name: str, value: object, expected: str) -> Any:  # noqa: ANN401 - never returns
        """Refuse a value that does not fit."""
        end = f"; {self.remedy}" if self.remedy else ""
        raise FaceDiffError(f"{self.source}: {name} is {quoted(value)}; expected {expected}{end}")


@functools.cache
def _fields(kind: Any) -> dict[str, tuple[Field[Any], Any]]:  # noqa: ANN401
    """The fields of a dataclass that a file states, with their type hints."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {field.name: (field, hints[field.name]) for field in fields(kind) if not field.metadata.get("derived")}
