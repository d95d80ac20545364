"""Constructor arguments that a file states: plain values, each as the constructor's signature asks for it.

Lightning and jsonargparse import class paths, open configs and resolve ``${…}`` wherever a value lets them. Arguments
that a checkpoint states go through here first: what passes cannot be read as anything but the value that it is.
"""

from __future__ import annotations

import inspect
import math
import re
import types
import typing
from collections.abc import Callable, Collection, Mapping
from collections.abc import Set as AbstractSet
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from facediff.errors import FaceDiffError
from facediff.utils.limits import quoted

LONGEST_TEXT = 4096
"""Characters of a text, as long as a path may be."""

LONGEST_NAME = 200
"""Characters of the name of a speaker, a clip or a class."""

RESERVED = {"class_path", "init_args", "dict_kwargs", "_class_path", "_instantiator", "__path__"}
"""Keys by which Lightning and jsonargparse recognise something to import or to open."""

Components = Mapping[str, Callable[[str], type | None]]
"""For each kind of component, what finds a class by its import path; None if it is not known."""


def read_options(source: str, owner: type, options: Mapping[str, Any], components: Components) -> dict[str, Any]:
    """The arguments of a constructor from what a file states, or an error where they are anything but plain values.

    Args:
        source: the file, for messages.
        owner: the class, which is known to be registered.
        options: its constructor's arguments as plain data.
        components: the kinds of components; an option of a kind's name takes one.

    Returns:
        the arguments as the constructor takes them: a component as ``functools.partial`` of its class.
    """
    hints = parameters(owner)
    arguments: dict[str, Any] = {}
    for name, value in options.items():
        if name not in hints:
            raise FaceDiffError(
                f"{source}: its {owner.__name__} has an option {quoted(name)} that this version does not know; it was "
                f"not loaded. Use the version of the package that wrote it"
            )
        if name in components:
            arguments[name] = read_component(source, name, value, components)
        elif fits(value, hints[name]):
            arguments[name] = as_hinted(value, hints[name])
        else:
            raise FaceDiffError(
                f"{source}: its option {name} is {quoted(value)}; expected {in_words(hints[name])}; it was not loaded"
            )
    for name in getattr(owner, "checkpoint_options", ()):
        if options.get(name) is None:
            raise FaceDiffError(
                f"{source}: its {owner.__name__} does not state {name}, and would read other files instead; it was not "
                f"loaded. Expected a checkpoint that `facediff fit` has written"
            )
    return arguments


def read_component(source: str, name: str, value: object, components: Components) -> partial[Any] | None:
    """A component that a file states; None where a model leaves it out.

    Raises:
        FaceDiffError: if it is not a known component of its kind with plain options.
    """
    if value is None:
        return None
    if not isinstance(value, dict) or not {"class_path"} <= value.keys() <= {"class_path", "init_args"}:
        raise FaceDiffError(
            f"{source}: its {name} is {quoted(value)}; expected a component with its class and options; it was not "
            f"loaded"
        )
    component = components[name](value["class_path"]) if is_path(value["class_path"]) else None
    if component is None:
        raise unknown_class(source, name, value["class_path"])
    options = value.get("init_args", {})
    if not isinstance(options, dict):
        raise FaceDiffError(f"{source}: the options of its {name} are {quoted(options)}; expected a dict")
    return partial(component, **read_options(source, component, options, components))


def unknown_class(source: object, role: str, named: object) -> FaceDiffError:
    """The error for a class that is neither registered nor imported."""
    shown = quoted(named).strip("'\"")
    own = f", or add --model={shown} to `facediff test`, `validate` or `predict`" if role == "model" else ""
    return FaceDiffError(
        f'{source}: its {role} is "{shown}", which is not known; it was not loaded. If you trust the file, install or '
        f"import the package that the {role} comes from{own}"
    )


def is_path(value: object) -> bool:
    """Whether a value can be the import path of a class."""
    return (
        isinstance(value, str)
        and len(value) <= 2 * LONGEST_NAME
        and "." in value
        and all(part.isidentifier() for part in value.split("."))
    )


def parameters(owner: type) -> dict[str, Any]:
    """The type hints of a constructor's parameters by name, those that ``**options`` hands on to a base class included.

    A parameter without a hint, or whose hint cannot be resolved here, has Any.
    """
    hints_by_name: dict[str, Any] = {}
    for cls in owner.__mro__:
        init = vars(cls).get("__init__")
        if not inspect.isfunction(init):
            continue
        try:
            hints = typing.get_type_hints(init, include_extras=True)
        except Exception:  # noqa: BLE001 - names that only type checkers import, and whatever evaluating raises
            hints = {}
        own = list(inspect.signature(init).parameters.values())[1:]
        named = [p for p in own if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL)]
        hints_by_name = {p.name: hints.get(p.name, Any) for p in named} | hints_by_name
        if all(p.kind is not p.VAR_KEYWORD for p in own):
            break
    return hints_by_name


def fits(value: object, hint: Any) -> bool:  # noqa: ANN401 - a type hint
    """Whether plain data is a value of a type hint; whatever could name something to import fits none.

    >>> fits(3, int), fits("3", int), fits(["a"], list[str]), fits("os.system", Callable[..., None])
    (True, False, True, False)
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return fits(value, inner[0])
    if origin in (Union, types.UnionType):
        return any(fits(value, part) for part in inner)
    if origin is Literal:
        return any(type(value) is type(word) and value == word for word in inner)
    if hint is None or hint is type(None):
        return value is None
    if hint is bool:
        return isinstance(value, bool)
    if hint in (int, float):
        number = isinstance(value, int | float if hint is float else int) and not isinstance(value, bool)
        return number and not (isinstance(value, float) and math.isnan(value))
    if hint in (str, Path):
        return isinstance(value, str) and is_plain_text(value)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return fits(value, int | str)
    kind = origin or hint
    if kind is tuple:
        if not isinstance(value, list | tuple) or not inner or inner[-1] is Ellipsis:
            return isinstance(value, list | tuple) and all(fits(item, inner[0] if inner else Any) for item in value)
        return len(value) == len(inner) and all(map(fits, value, inner))
    if isinstance(kind, type) and issubclass(kind, Mapping):
        key, item = inner or (str, Any)
        return (
            isinstance(value, dict)
            and not RESERVED & value.keys()
            and all(isinstance(name, str) and is_plain_text(name) for name in value)
            and all(fits(part, item) for part in value.values())
        )
    if isinstance(kind, type) and kind is not type and issubclass(kind, Collection | AbstractSet):
        return isinstance(value, list | tuple) and all(fits(item, inner[0] if inner else Any) for item in value)
    return is_inert(value) if hint is Any or hint is object or isinstance(hint, typing.TypeVar) else False


def as_hinted(value: Any, hint: Any) -> Any:  # noqa: ANN401 - a type hint and its value
    """Plain data that fits a hint, in the form that the hint asks for; undoes :func:`facediff.registry.plain`.

    >>> as_hinted([1, 2], tuple[int, ...] | None)
    (1, 2)
    """
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return as_hinted(value, inner[0])
    if origin in (Union, types.UnionType):
        return as_hinted(value, next(part for part in inner if fits(value, part)))
    if isinstance(value, list | tuple) and (origin or hint) in (tuple, set, frozenset):
        return (origin or hint)(value)
    if isinstance(hint, type) and issubclass(hint, Path) and isinstance(value, str):
        return Path(value)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint(value)
    return float(value) if hint is float else value


def is_inert(value: object) -> bool:
    """Whether a value means itself even where a parser may take it for YAML."""
    if isinstance(value, dict):
        return fits(value, dict[str, Any])
    if isinstance(value, list | tuple):
        return all(map(is_inert, value))
    if isinstance(value, str):
        special = re.search(r"[{}\[\]&*!|>%@`#,\"'?]|:\s|:$|^[-?:]\s|^-+$", value)
        return special is None and is_plain_text(value)
    return value is None or isinstance(value, bool | int | float)


def is_plain_text(text: str) -> bool:
    """Whether a text neither refers to a resolver or to another machine nor holds control characters."""
    return (
        len(text) <= LONGEST_TEXT
        and text.isprintable()
        and "${" not in text
        and "://" not in text
        and not text.startswith(("\\\\", "//"))
    )


def is_name(text: object) -> bool:
    """Whether a text can name a speaker or a clip in tables and file names."""
    return (
        isinstance(text, str)
        and 0 < len(text) <= LONGEST_NAME
        and text.isprintable()
        and not set(text) & set("/\\")
        and text not in (".", "..")
    )


def in_words(hint: Any) -> str:  # noqa: ANN401 - a type hint
    """A type hint for a message."""
    origin, inner = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return in_words(inner[0])
    if origin in (Union, types.UnionType):
        return " or ".join(in_words(part) for part in inner if part is not type(None))
    if origin is list:
        return f"a list, each {in_words(inner[0])}"
    if isinstance(hint, type) and not inner:
        return {int: "a whole number", float: "a number", bool: "true or false", str: "plain text"}.get(
            hint, hint.__name__
        )
    if get_origin(hint) is Literal:
        return f"one of {', '.join(map(str, get_args(hint)))}"
    return "a plain value" if hint is Any else str(hint).replace("typing.", "").replace("collections.abc.", "")
