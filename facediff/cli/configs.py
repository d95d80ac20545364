"""YAML configs before jsonargparse reads them: UTF-8, a mapping, and each key once.

A config is the user's own and may name classes and environment variables; it may still be damaged, or be another file.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from facediff.errors import FaceDiffError
from facediff.registry import with_paths
from facediff.utils.files import config_dir
from facediff.utils.paths import from_home
from facediff.utils.yaml_files import check_yaml, yaml_text


def check_config(path: Path | str) -> None:
    """Refuse a file that is no config."""
    expected = "expected a YAML file such as configs/experiment/puppet.yaml"
    text = yaml_text(path, expected)
    check_yaml(text, path)
    if not isinstance(yaml.compose(text, yaml.SafeLoader), yaml.MappingNode):
        raise FaceDiffError(f"{path}: holds no options (key: value); {expected}")


def texts_of(path: Path | str) -> dict[str, Any]:
    """A config that :func:`check_config` has let through, with every value as its text."""
    content: dict[str, Any] = yaml.load(Path(path).read_text(encoding="utf-8-sig"), yaml.BaseLoader)  # noqa: S506
    return content


def keys_of(path: Path | str) -> set[str]:
    """The outermost keys of a config."""
    return set(texts_of(path))


def name_of(path: Path | str) -> str | None:
    """The experiment's name that a config states; None for none."""
    return texts_of(path).get("name")


def class_of(path: Path | str) -> str | None:
    """The class that a config states: the model's, or of its only part."""
    content = texts_of(path)
    model = content.get("model", content)  # a file of one part alone has its class outermost
    if isinstance(model, str) and (part := Path(path).parent / model).is_file():
        check_config(part)
        return class_of(part)
    path_of_class = model.get("class_path") if isinstance(model, dict) else model
    return path_of_class if isinstance(path_of_class, str) else None


PARTS = ("model", "data", "trainer")
"""Folders of the bundled configs that hold one part of an experiment, and the options that take such a part."""


def bundled_config(name: str) -> Path | None:
    """The file of a bundled config: of ``configs/trainer/cpu.yaml`` or, shorter, ``trainer/cpu``; None for others."""
    if not re.fullmatch(r"[\w./-]{1,200}", name):
        return None
    file = config_dir() / name.removeprefix("configs/")
    return next((path for path in (file, file.with_name(f"{file.name}.yaml")) if path.is_file()), None)


def as_parts(arguments: Sequence[str]) -> list[str]:
    """The words with ``--trainer FILE`` in place of ``--config FILE`` where a bundled config holds that part alone."""
    parts = list(arguments)
    for number, word in enumerate(parts):
        flag, joined, value = word.partition("=")
        if flag in ("-c", "--config"):
            path = Path(value if joined else next(iter(parts[number + 1 :]), ""))
            if path.parent.name in PARTS and path.parent.parent == config_dir():
                parts[number] = f"--{path.parent.name}{joined}{value}"
    return parts


def with_files(content: Any) -> Any:  # noqa: ANN401
    """A config's content with the user's home in its paths, and the bundled files that the user does not have."""
    from jsonargparse.typing import Path_fr

    if isinstance(content, dict):
        return {key: with_files(value) for key, value in content.items()}
    if isinstance(content, list):
        return [with_files(value) for value in content]
    if isinstance(content, str) and content.startswith("configs/"):
        try:
            Path_fr(content)  # relative to the file that names it, as jsonargparse reads it
        except TypeError:
            return str(bundled_config(content) or content)
    return from_home(content)


def guard_configs(mode: str) -> None:
    """Let jsonargparse check every YAML text of a parser mode before it reads it: also files that a config names."""
    from jsonargparse import set_loader
    from jsonargparse._optionals import get_omegaconf_loader  # its public get_loader knows the mode after a parse only

    from facediff.models.earlier_versions import without_removed_options

    read = get_omegaconf_loader(mode)  # type: ignore[no-untyped-call]

    def load(text: str) -> Any:  # noqa: ANN401
        if "\n" in text:  # a file, and not a value
            try:
                check_yaml(text, "--config")
            except FaceDiffError as error:
                if isinstance(error.__cause__, yaml.YAMLError):  # jsonargparse then tries other types
                    raise error.__cause__ from error
                raise
        return with_paths(without_removed_options(with_files(read(text)), "--config"))

    set_loader(mode, load, exceptions=(yaml.YAMLError,))
