"""Words and YAML configs of Lightning's subcommands before jsonargparse reads them.

A config is the user's own and may name classes and environment variables; it may still be damaged, or be another file.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from facediff import registry
from facediff.errors import FaceDiffError, choices, import_failure, lacking
from facediff.utils.files import config_dir
from facediff.utils.hints import is_path
from facediff.utils.paths import from_home
from facediff.utils.yaml_files import check_yaml, yaml_text

YAML = (".yaml", ".yml")


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


def guard_configs() -> None:
    """Let jsonargparse check every YAML text before it reads it: also files that a config names."""
    from jsonargparse import set_loader
    from jsonargparse._optionals import get_omegaconf_loader  # its public get_loader knows the mode after a parse only

    from facediff.models.earlier_versions import without_removed_options

    read = get_omegaconf_loader("omegaconf+")  # type: ignore[no-untyped-call]

    def load(text: str) -> Any:  # noqa: ANN401
        if "\n" in text:  # a file, and not a value
            try:
                check_yaml(text, "--config")
            except FaceDiffError as error:
                if isinstance(error.__cause__, yaml.YAMLError):  # jsonargparse then tries other types
                    raise error.__cause__ from error
                raise
        return registry.with_paths(without_removed_options(with_files(read(text)), "--config"))

    set_loader("omegaconf+", load, exceptions=(yaml.YAMLError,))


def change_values(arguments: Sequence[str], change: Callable[[str, str], str]) -> list[str]:
    """The words with ``change(flag, value)`` in place of every value, written ``--flag value`` or ``--flag=value``."""
    changed, flag = [], ""
    for word in arguments:
        if word.startswith("-"):
            flag, joined, value = word.partition("=")
            changed.append(f"{flag}={change(flag, value)}" if joined else word)
            flag = "" if joined else flag
        else:
            changed.append(change(flag, word))
            flag = ""
    return changed


def value_of(arguments: Sequence[str], flag: str) -> str | None:
    """The first value of a flag; None if it is not given."""
    return next((value for option, value in values_in(arguments) if option == flag), None)


def values_in(arguments: Sequence[str]) -> list[tuple[str, str]]:
    """Every value with its flag, in the order of the words; the flag is empty for a word that follows none."""
    values: list[tuple[str, str]] = []

    def note(flag: str, value: str) -> str:
        values.append((flag, value))
        return value

    change_values(arguments, note)
    return values


def explain(arguments: Sequence[str]) -> str:
    """The fault of a class that words or the files in them name; empty if there is none.

    An error inside a file of the user's comes with its file and line; a name of a model, a corpus or a component that
    does not exist, with the nearest; and an option before its config. Everything else is the parser's to say.
    """
    classes: list[tuple[str, str]] = []
    for flag, value in values_in(arguments):
        option = "" if flag in ("-c", "--config") else flag.lstrip("-").removesuffix("+").removesuffix(".help")
        try:
            content = yaml.load(value, yaml.BaseLoader)  # noqa: S506 - makes texts only
        except yaml.YAMLError:
            content = value
        classes.extend(classes_in(option, content, Path.cwd()))
    faults = filter(None, (fault_of(option, name) for option, name in dict.fromkeys(classes)))
    return next(faults, "") or next((f"{flag} {EARLY}" for flag, _ in early_options(arguments)), "")


EARLY = "stands before --config; give options after --config, which they change"


def early_options(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Options of a part of a config that stand before a config, ``--model.dim``, each with the config's file."""
    earlier: list[str] = []
    for flag, value in values_in(arguments):
        if flag in ("-c", "--config"):
            yield from ((option, value) for option in earlier)
        elif flag.startswith("--") and "." in flag:
            earlier.append(flag)


def refuse_early(arguments: Sequence[str]) -> None:
    """Refuse options that stand before a config which sets them again: the config would count, without a word."""
    for flag, file in early_options(arguments):
        if os.path.isfile(file):  # noqa: PTH113 - also of a long text
            content = yaml.load(Path(file).read_text("utf-8-sig"), yaml.BaseLoader)  # noqa: S506
            if _sets(content, flag[2:]):
                raise FaceDiffError(f"{flag} {EARLY}: {file} sets it too")


def _sets(content: Any, option: str) -> bool:  # noqa: ANN401
    """Whether a config's content sets an option; a text in its place is a class or a file, and sets all of it."""
    name, _, rest = option.partition(".")
    if not isinstance(content, dict) or not option:
        return bool(content)
    holders = [holder for holder in (content, content.get("init_args")) if isinstance(holder, dict)]
    return any(_sets(holder[name], rest) for holder in holders if name in holder)


def classes_in(option: str, content: Any, folder: Path) -> Iterator[tuple[str, str]]:  # noqa: ANN401
    """Names and import paths of classes in a config's content, each with the option that it stands for."""
    if isinstance(content, dict):
        for name, value in content.items():
            path = option if name in ("class_path", "init_args") else f"{option}.{name}".strip(".+")
            yield from classes_in(path, value, folder)
    elif isinstance(content, list):
        for value in content:
            yield from classes_in(option, value, folder)
    elif isinstance(content, str) and content.endswith(YAML):
        if (file := folder / content).is_file():
            text = file.read_text("utf-8-sig")
            yield from classes_in(option, yaml.load(text, yaml.BaseLoader), file.parent)  # noqa: S506
    elif isinstance(content, str) and content not in ("", "null"):
        yield option, content


def fault_of(option: str, name: str) -> str:
    """The fault of a class by its name or import path; empty if there is none, or the parser reports it."""
    if is_path(name):
        return import_fault(option, name)
    kinds = {**registry.COMPONENTS, "model": registry.model, "data": registry.corpus}
    kind = kinds.get(option.rpartition(".")[2])
    if kind is None or not name.isidentifier() or name in kind.names() or name in subclasses(kind):
        return ""
    return kind.unknown(name)


def subclasses(kind: registry.Kind) -> set[str]:
    """Names of the imported classes that extend a base of the registered ones."""
    ancestors = (base for entry in kind for base in entry.implementation.__mro__)
    bases: set[type] = {base for base in ancestors if base.__module__.startswith("facediff.")}
    extension: type
    names: set[str] = set()
    for base in bases:
        for extension in base.__subclasses__():
            names.add(extension.__name__)
    return names


def import_fault(option: str, path: str) -> str:
    """Why an import path leads to no class that can be made; empty if it does, or leads to no file."""
    module, _, name = path.rpartition(".")
    try:
        cls = vars(importlib.import_module(module)).get(name)
    except Exception as error:  # a module can fail in any way while it is imported
        unknown = getattr(error, "name", None) if isinstance(error, ModuleNotFoundError) else None
        return (
            "" if unknown and f"{module}.".startswith(f"{unknown}.") else f"--{option} {path}: {import_failure(error)}"
        )
    if cls is None and not module.startswith(("facediff.", "torch.", "lightning.")):
        classes = [n for n, value in vars(importlib.import_module(module)).items() if isinstance(value, type)]
        return f"--{option} {path}: {module} has no {name}: {choices(name, classes)}"
    return f"--{option} {path}: {fault}" if (fault := lacking(cls)) else ""
