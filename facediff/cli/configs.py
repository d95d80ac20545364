"""YAML configs before jsonargparse reads them: UTF-8, a mapping, each key once, and no more than the budget.

A config is the user's own and may name classes and environment variables; it may still be damaged, or be another file.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError
from facediff.utils.yaml_files import check_yaml, yaml_text

SHORT = 32  # characters of a value that can neither expand nor recurse


def check_config(path: Path | str) -> None:
    """Refuse a file that is no config.

    Raises:
        FaceDiffError: naming the file and the line.
    """
    expected = "expected a YAML file such as configs/experiment/puppet.yaml"
    if check_yaml(yaml_text(path, expected), path) is not dict:
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
