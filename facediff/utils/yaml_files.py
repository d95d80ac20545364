"""YAML files: UTF-8, plain data only, and each key once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError, damaged
from facediff.utils.limits import quoted


def load_yaml(path: Path, remedy: str) -> dict[str, Any]:
    """The mapping that a YAML file holds; its values are plain data, and dates stay text."""
    text = yaml_text(path, remedy)
    check_yaml(text, path)
    with damaged(f"{path}: is not readable as YAML", remedy, yaml.YAMLError):  # a list as a key, say
        content = yaml.load(text, Loader=_Plain)  # noqa: S506 - a safe loader that knows fewer types
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
    with damaged(f"{path}: not readable as UTF-8", remedy, OSError):
        return Path(path).read_text(encoding="utf-8-sig")


def check_yaml(text: str, source: object) -> None:
    """Refuse a YAML text that cannot be parsed or gives a key twice, of which YAML's parsers take the last silently."""
    with damaged(f"{source}: is not readable as YAML", "correct the line", yaml.YAMLError, RecursionError):
        nodes, visited = [yaml.compose(text, getattr(yaml, "CSafeLoader", yaml.SafeLoader))], set[int]()
    while nodes:
        node = nodes.pop()
        if id(node) in visited or not isinstance(node, yaml.CollectionNode):
            continue
        visited.add(id(node))  # an alias is the node that it names
        if isinstance(node, yaml.SequenceNode):
            nodes += node.value
            continue
        keys = set[str]()
        for key, value in node.value:
            nodes += (key, value)
            if not isinstance(key, yaml.ScalarNode):
                continue
            if key.value in keys and key.value != "<<":
                line = key.start_mark.line + 1
                raise FaceDiffError(f"{source}, line {line}: {quoted(key.value)} is given twice; keep one of them")
            keys.add(key.value)
