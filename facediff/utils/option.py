"""What a type hint cannot say about an option of the command line.

Stands below all packages, so that the dataclasses of options can carry it; :mod:`facediff.cli.parsing` reads it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal


@dataclass(frozen=True)
class Option:
    """What a type hint cannot say about an option; used as ``Annotated[float, Option(...)]``.

    Which numbers an option takes is declared by a :class:`~facediff.utils.ranges.Range`.

    Attributes:
        also: another flag, such as ``-o``.
        metavar: the name or, for a pair, the names of the value in the help text.
        many: for lists, whether one flag takes several values; else the flag is repeated.
        bare: the value if the option is given without one; None if a value is needed.
        reads: for paths, and texts that hold paths: whether the file or folder is read.
        writes: for paths: what is written; with ``reads``, what exists is read instead.
        dash: for paths: whether ``-`` stands for standard input or output.
        hidden: for fields of a dataclass: whether programs set it, and the command line has no such option.
    """

    also: str = ""
    metavar: str | tuple[str, ...] = ""
    many: bool = False
    bare: Any = None
    reads: bool = False
    writes: Literal["", "file", "folder", "file or folder"] = ""
    dash: bool = False
    hidden: bool = False
