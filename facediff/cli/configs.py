"""YAML configs before jsonargparse reads them: UTF-8, a mapping, each key once, and no more than the budget.

A config is the user's own and may name classes and environment variables; it may still be damaged, or be another file.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError
from facediff.utils.limits import LIMITS, brief, quoted

CONFIG_BYTES = 2**20
"""Most bytes of a config."""

SHORT = 32  # characters of a value that can neither expand nor recurse


def check_config(path: Path | str) -> None:
    """Refuse a file that is no config.

    Raises:
        FaceDiffError: naming the file and the line.
    """
    expected = "expected a YAML file such as configs/experiment/puppet.yaml"
    try:
        if os.path.getsize(path) > CONFIG_BYTES:
            raise FaceDiffError(f"{path}: has more than {CONFIG_BYTES} bytes; {expected}")
        text = Path(path).read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {expected}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is not UTF-8 (byte {error.start}); save it as UTF-8. Also {expected}") from error
    if check_yaml(text, path) is not dict:
        raise FaceDiffError(f"{path}: holds no options (key: value); {expected}")


def keys_of(path: Path | str) -> set[str]:
    """The outermost keys of a config that :func:`check_config` has let through."""
    # The node's tree is neither expanded nor made into objects.
    root = yaml.compose(Path(path).read_text(encoding="utf-8-sig"), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    return {str(key.value) for key, _ in root.value} if isinstance(root, yaml.MappingNode) else set()


def guard_configs(mode: str) -> None:
    """Let jsonargparse check every YAML text of a parser mode before it reads it: also files that a config names."""
    from jsonargparse import set_loader
    from jsonargparse._optionals import get_omegaconf_loader

    read = get_omegaconf_loader(mode)  # type: ignore[no-untyped-call]

    def load(text: str) -> Any:  # noqa: ANN401
        if len(text) > SHORT:
            try:
                check_yaml(text, "--config")
            except FaceDiffError as error:
                if isinstance(error.__cause__, yaml.YAMLError):  # jsonargparse then tries what else it may be
                    raise error.__cause__ from error
                raise
        return read(text)

    set_loader(mode, load, exceptions=(yaml.YAMLError,))


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

    Raises:
        FaceDiffError: naming the source and the line.
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
