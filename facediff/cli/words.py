"""The words of Lightning's subcommands: their values, and why a class that they or their files name cannot be taken."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import yaml

from facediff import registry
from facediff.errors import FaceDiffError, choices, import_failure, lacking
from facediff.utils.hints import is_path

YAML = (".yaml", ".yml")


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
    values: dict[str, str] = {}
    change_values(arguments, lambda option, value: values.setdefault(option, value))
    return values.get(flag)


def explain(arguments: Sequence[str]) -> str:
    """The fault of a class that words or the files in them name; empty if there is none.

    An error inside a file of the user's comes with its file and line; a name of a model, a corpus or a component that
    does not exist, with the nearest; and an option before its config. Everything else is the parser's to say.
    """
    classes: list[tuple[str, str]] = []

    def note(flag: str, value: str) -> str:
        option = "" if flag in ("-c", "--config") else flag.lstrip("-").removesuffix("+").removesuffix(".help")
        try:
            content = yaml.load(value, yaml.BaseLoader)  # noqa: S506 - makes texts only
        except yaml.YAMLError:
            content = value
        classes.extend(classes_in(option, content, Path.cwd()))
        return value

    change_values(arguments, note)
    faults = filter(None, (fault_of(option, name) for option, name in dict.fromkeys(classes)))
    return next(faults, "") or next((f"{flag} {EARLY}" for flag, _ in early_options(arguments)), "")


EARLY = "stands before --config; give options after --config, which they change"


def early_options(arguments: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Options of a part of a config that stand before a config, ``--model.dim``, each with the config's file."""
    earlier: list[str] = []
    found: list[tuple[str, str]] = []

    def look(flag: str, value: str) -> str:
        if flag in ("-c", "--config"):
            found.extend((option, value) for option in earlier)
        elif flag.startswith("--") and "." in flag:
            earlier.append(flag)
        return value

    change_values(arguments, look)
    yield from found


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
    bases = {base for entry in kind for base in entry.implementation.__mro__ if base.__module__.startswith("facediff.")}
    cls: type
    names: set[str] = set()
    for base in bases:
        for cls in base.__subclasses__():
            names.add(cls.__name__)
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
