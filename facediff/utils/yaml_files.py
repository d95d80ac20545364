"""YAML from elsewhere: UTF-8, each key once, no more than the budget, and plain data only."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, brief, quoted

YAML_BYTES = 2**20
"""Most bytes of a file."""


def load_yaml(path: Path, remedy: str) -> dict[str, Any]:
    """The mapping that a YAML file holds; its values are plain data, and dates stay text.

    Args:
        path: the file.
        remedy: how messages end.
    """
    text = yaml_text(path, remedy)
    if check_yaml(text, path) is not dict:
        raise FaceDiffError(f"{path}: holds no mapping (key: value); {remedy}")
    try:
        content = yaml.load(text, Loader=_Plain)  # noqa: S506 - a safe loader that knows fewer types
    except (yaml.YAMLError, ValueError, TypeError) as error:  # a list as a key, say
        raise FaceDiffError(f"{path}: is not readable as YAML ({brief(error)}); {remedy}") from error
    wrong = next((key for key in content if not isinstance(key, str)), None)
    if wrong is not None:
        raise FaceDiffError(f"{path}: has the key {quoted(wrong)}, which is no text; {remedy}")
    return dict(content)


class _Plain(yaml.SafeLoader):
    """The safe loader without dates, which nothing here asks for and JSON has no word for."""

    yaml_implicit_resolvers = {
        letter: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
        for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def yaml_text(path: Path | str, remedy: str) -> str:
    """The text of a YAML file; ``remedy`` is how messages end."""
    try:
        if os.path.getsize(path) > YAML_BYTES:
            raise FaceDiffError(f"{path}: has more than {YAML_BYTES} bytes; {remedy}")
        return Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is not UTF-8 (byte {error.start}); save it as UTF-8. Also {remedy}") from error


class Level:
    """An open list or mapping of a YAML text.

    Attributes:
        anchor: the name by which the text refers to it again.
        keys: the keys of a mapping so far; None for a list.
        size: its entries, each alias counted as what it stands for.
        is_key: whether a key comes next.
    """

    def __init__(self, anchor: str | None, *, mapping: bool) -> None:
        self.anchor = anchor
        self.keys: set[str] | None = set() if mapping else None
        self.size = 1
        self.is_key = mapping


def check_yaml(text: str, source: object) -> type | None:
    """Refuse a YAML text that refers to itself, expands beyond the budget, or gives a key twice.

    The parser's events are read one by one: unlike its objects, they neither expand nor recurse.

    Returns:
        dict or list, as the text holds one of them; None otherwise.
    """
    levels: list[Level] = []
    sizes: dict[str, int] = {}
    outermost: type | None = None
    try:
        for event in yaml.parse(text, Loader=getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            mark: Any = event.start_mark
            place = f"{source}, line {mark.line + 1}"
            if isinstance(event, yaml.MappingStartEvent | yaml.SequenceStartEvent):
                mapping = isinstance(event, yaml.MappingStartEvent)
                outermost = outermost or (dict if mapping else list)
                levels.append(Level(event.anchor, mapping=mapping))
                LIMITS.check("nesting", len(levels), place)
                continue
            if isinstance(event, yaml.MappingEndEvent | yaml.SequenceEndEvent):
                ended = levels.pop()
                size, anchor, key = ended.size, ended.anchor, None
            elif isinstance(event, yaml.AliasEvent):
                if event.anchor not in sizes:
                    raise FaceDiffError(f"{place}: *{quoted(event.anchor)[1:-1]} refers to itself or to nothing")
                size, anchor, key = sizes[event.anchor], None, None
            elif isinstance(event, yaml.ScalarEvent):
                size, anchor, key = 1, event.anchor, event.value
            else:
                continue
            if anchor:
                sizes[anchor] = size
            if levels:
                add(levels[-1], size, key, place)
    except yaml.YAMLError as error:
        raise FaceDiffError(f"{source}: is not readable as YAML ({brief(error)}); correct the line") from error
    except (ValueError, RecursionError) as error:
        raise FaceDiffError(f"{source}: is not readable as YAML ({brief(error)})") from error
    return outermost


def add(level: Level, size: int, key: Any, place: str) -> None:  # noqa: ANN401
    """Count an entry of a list or mapping.

    Raises:
        FaceDiffError: if it is a key that is there already, or one entry too many.
    """
    level.size += size
    LIMITS.check("entries", level.size, place)
    if level.keys is None:
        return
    if level.is_key and key is not None and key != "<<":
        if key in level.keys:
            raise FaceDiffError(f"{place}: {quoted(key)} is given twice; keep one of them")
        level.keys.add(key)
    level.is_key = not level.is_key
