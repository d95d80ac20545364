"""The properties of a command-line option beyond its type hint.

Stands below all packages, so that the dataclasses of options can carry it; :mod:`facediff.cli.parsing` reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Option:
    """The properties of an option beyond its type hint; used as ``Annotated[float, Option(...)]``."""

    also: str = ""  # another flag, such as -o
    metavar: str | tuple[str, ...] = ""  # the name or, for a pair, the names of the value in the help text
    many: bool = False  # for lists, whether one flag takes several values; else the flag is repeated
    bare: Any = None  # the value if the option is given without one; None if a value is needed
    needs: str = ""  # names of options, separated by spaces, without all of which this one would change nothing
    without: str = ""  # names of options with any of which this one would change nothing
    reads: bool = False  # for paths, and texts that hold paths: whether the file or folder is read
    exists: Literal["", "file", "folder", "file or folder"] = ""  # kind of an input that must exist before
    writes: Literal["", "file", "folder", "file or folder"] = ""  # kind of the output; with reads, read if it exists
    new: bool = False  # for paths that are written: whether they must not exist, or be empty folders
    suffixes: tuple[str, ...] = ()  # of paths
    dash: bool = False  # for paths: whether - stands for standard input or output
    check: Callable[[Any], object] | None = None  # raises an error for a value that the command cannot use
    hidden: bool = False  # for fields of a dataclass: whether the command line has no such option
