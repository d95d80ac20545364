"""Hyper-parameters as plain data, so that a checkpoint loads with ``weights_only=True`` however it was made."""

from __future__ import annotations

import inspect
from collections.abc import Mapping, Sequence, Set
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from facediff.registry import alias_path


def plain(value: Any) -> Any:  # noqa: ANN401
    """Describe a constructor argument by numbers, strings, lists and dicts.

    A component class, or a ``functools.partial`` of one (which is also what the command line hands over), becomes
    Lightning's form ``{"class_path": …, "init_args": {…}}``.

    Raises:
        TypeError: if the value has no plain description; the message says which forms have one.
    """
    if isinstance(value, Enum):  # before the numbers and strings, which members of some enumerations are too
        return plain(value.value)
    if value is None or isinstance(value, bool | int | float | str):
        # Subclasses such as numpy.float64 would not load again with weights_only=True.
        return value if value is None or type(value) in (bool, int, float, str) else _exact(value)
    if isinstance(value, type):
        return {"class_path": alias_path(value), "init_args": {}}
    if isinstance(value, partial):
        return {"class_path": alias_path(component_class(value)), "init_args": plain(value.keywords)}
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, Sequence | Set) and not isinstance(value, bytes | bytearray | memoryview):
        return [plain(item) for item in value]
    if hasattr(value, "items"):
        return {str(key): plain(item) for key, item in value.items()}
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    raise TypeError(
        f"a {type(value).__name__} cannot be kept in a checkpoint; give a component as its class or as "
        f"functools.partial(class, option=value), and everything else as numbers, strings, lists and dicts"
    )


def _exact(value: bool | int | float | str) -> bool | int | float | str:
    for kind in (bool, int, float, str):
        if isinstance(value, kind):
            return kind(value)
    return value


def component_class(factory: Any) -> type:  # noqa: ANN401
    """The class that a factory makes an instance of.

    Args:
        factory: a class, a ``functools.partial`` of one, or jsonargparse's partial, which holds the class among its
            arguments.
    """
    if isinstance(factory, type):
        return factory
    if isinstance(factory, partial):
        for candidate in (factory.func, *factory.args):
            if isinstance(candidate, type):
                return candidate
    raise TypeError(f"{factory!r} is no component; give its class or functools.partial(class, option=value)")


def defaults(component: type) -> dict[str, Any]:
    """A component's own options with their defaults, as plain data; what a system gives it has no default."""
    parameters = inspect.signature(component).parameters.values()
    return {p.name: plain(p.default) for p in parameters if p.default is not inspect.Parameter.empty}


def describe(factory: Any, component: object) -> dict[str, Any]:  # noqa: ANN401
    """A component's plain description for the checkpoint, with every option that it was made with.

    Options left at their defaults are written down too: whoever rebuilds the component may fill what is missing from
    the component that usually stands in its place. A component may have a method ``checkpoint_init_args`` that returns
    constructor arguments which let it be built without the files that it was first built from (a pretrained network,
    say).
    """
    description: dict[str, Any] = plain(factory)
    description["init_args"] = {**defaults(component_class(factory)), **description["init_args"]}
    extra = getattr(component, "checkpoint_init_args", None)
    if extra is not None:
        description["init_args"] = {**description["init_args"], **plain(extra())}
    return description
