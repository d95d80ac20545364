"""Packages with public names that are imported on first use.

``facediff.models`` imports Lightning, ``facediff.data`` too: seconds that a wrong option or ``--help`` must not cost.
Depends on the standard library only.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable, Mapping
from typing import Any


def lazy_names(
    package: str, modules: Mapping[str, str], packages: str = ""
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """``__getattr__``, ``__dir__`` and ``__all__`` of a package with names that are loaded on first use (PEP 562).

    They are public names of its modules, and packages inside it, each separated by spaces.

    Example:
        >>> __getattr__, __dir__, __all__ = lazy_names("facediff.mesh", {"mesh": "Mesh read_mesh"})
        >>> __all__
        ['Mesh', 'read_mesh']
    """
    owner = {name: f"{package}.{module}" for module, names in modules.items() for name in names.split()}
    inside = packages.split()

    def get(name: str) -> object:
        if name in inside:
            return importlib.import_module(f"{package}.{name}")  # which also makes it an attribute of the package
        if name not in owner:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(importlib.import_module(owner[name]), name)
        setattr(sys.modules[package], name, value)  # found directly from now on
        return value

    names = {*owner, *inside}
    return get, lambda: sorted({*names, *vars(sys.modules[package])}), sorted(names)


def late(target: str) -> Callable[..., Any]:
    """A function by its name, ``package.module:function``, imported when it is called for.

    For methods of a plain class that call packages above it, which themselves work with the class.
    """
    module, _, name = target.partition(":")
    function: Callable[..., Any] = getattr(importlib.import_module(module), name)
    return function
