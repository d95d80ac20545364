"""YAML files: UTF-8, plain data only, and each key once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError
from facediff.utils.limits import brief, quoted


def load_yaml(path: Path, remedy: str) -> dict[str, Any]:
    """The mapping that a YAML file holds; its values are plain data, and dates stay text.

    Args:
        path: the file.
        remedy: how messages end.
    """
    text = yaml_text(path, remedy)
    check_yaml(text, path)
    try:
        content = yaml.load(text, Loader=_Plain)  # noqa: S506 - a safe loader that knows fewer types
    except (yaml.YAMLError, TypeError, ValueError) as error:  # a list as a key, say
        raise FaceDiffError(f"{path}: is not readable as YAML ({brief(error)}); {remedy}") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise FaceDiffError(f"{path}: holds {quoted(content)}, expected a mapping (key: value); {remedy}")
    return content


class _Plain(yaml.SafeLoader):
    """The safe loader without dates, which nothing here asks for and JSON has no word for."""

    yaml_implicit_resolvers = {
        letter: [(tag, pattern) for tag, pattern in resolvers if tag != "tag:yaml.org,2002:timestamp"]
        for letter, resolvers in yaml.SafeLoader.yaml_implicit_resolvers.items()
    }


def yaml_text(path: Path | str, remedy: str) -> str:
    """The text of a YAML file; ``remedy`` is how messages end."""
    try:
        return Path(path).read_text(encoding="utf-8-sig")
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {remedy}") from error
    except UnicodeDecodeError as error:
        raise FaceDiffError(f"{path}: is not UTF-8 (byte {error.start}); save it as UTF-8. Also {remedy}") from error


def check_yaml(text: str, source: object) -> None:
    """Refuse a YAML text that cannot be parsed or gives a key twice, of which YAML's parsers take the last silently."""
    try:
        waiting, seen = [yaml.compose(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))], set[int]()
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise FaceDiffError(f"{source}: is not readable as YAML ({brief(error)}); correct the line") from error
    while waiting:
        node = waiting.pop()
        if id(node) in seen or not isinstance(node, yaml.CollectionNode):
            continue
        seen.add(id(node))  # an alias is the node that it names
        if isinstance(node, yaml.SequenceNode):
            waiting += node.value
            continue
        keys = set[str]()
        for key, value in node.value:
            waiting += (key, value)
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in keys and key.value != "<<":
                line = key.start_mark.line + 1
                raise FaceDiffError(f"{source}, line {line}: {quoted(key.value)} is given twice; keep one of them")
            keys.add(key.value)
