"""The properties of a command-line option beyond its type hint.

Stands below all packages, so that the dataclasses of options can carry it; :mod:`facediff.cli.parsing` reads it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Option:
    """The properties of an option beyond its type hint; used as ``Annotated[float, Option(...)]``.

    Which numbers an option takes is declared by a :class:`~facediff.utils.hints.Range`.

    Attributes:
        also: another flag, such as ``-o``.
        metavar: the name or, for a pair, the names of the value in the help text.
        many: for lists, whether one flag takes several values; else the flag is repeated.
        bare: the value if the option is given without one; None if a value is needed.
        needs: names of options, separated by spaces, without all of which this one would change nothing.
        without: names of options with any of which this one would change nothing.
        reads: for paths, and texts that hold paths: whether the file or folder is read.
        exists: for paths: kind of the input that must exist, if it is known before the command begins.
        writes: for paths: kind of the output; with ``reads``, an existing one is read instead.
        new: for paths that are written: whether they must not exist, or be empty folders.
        suffixes: for paths: allowed ends of their names.
        dash: for paths: whether ``-`` stands for standard input or output.
        check: raises an error for a value that the command cannot use.
        hidden: for fields of a dataclass: whether programs set it, and the command line has no such option.
    """

    also: str = ""
    metavar: str | tuple[str, ...] = ""
    many: bool = False
    bare: Any = None
    needs: str = ""
    without: str = ""
    reads: bool = False
    exists: Literal["", "file", "folder", "file or folder"] = ""
    writes: Literal["", "file", "folder", "file or folder"] = ""
    new: bool = False
    suffixes: tuple[str, ...] = ()
    dash: bool = False
    check: Callable[[Any], object] | None = None
    hidden: bool = False
