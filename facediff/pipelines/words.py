"""Options of the command line in Python: what is given is made words, and errors come in Python's words.

``style={"F1_e03": 0.4, "M2_e05": 0.6}`` and ``--style F1_e03:0.4,M2_e05:0.6`` are one option, which is read and checked
in one place; that place names it as the command line does.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Mapping
from typing import ParamSpec, TypeVar

from facediff.errors import FaceDiffError

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

Scales = str | float | Mapping[str, float]
"""One number, or numbers by name: as the command line takes them, or as a mapping."""

_OPTION = re.compile(r"(?<![\w./-])--([a-z]+(?:-[a-z]+)*)\b(?!\.)")
_OWNER = re.compile(r"\b(?:(?:Animation|Export|Solve)(?:Options|Controls)|Source|save|check_seed)\.(?=\w+ \S+: )")
"""Whose argument is out of range; a function's own name says nothing where it is another one that was called."""


def in_python_words(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """A function whose errors name options as Python does: ``target_mesh`` and not ``--target-mesh``."""

    @functools.wraps(function)
    def translated(*arguments: Arguments.args, **options: Arguments.kwargs) -> Result:
        try:
            return function(*arguments, **options)
        except FaceDiffError as error:
            error.args = (python_words(str(error)),)
            raise

    return translated


def python_words(message: str) -> str:
    """A message in which options are called as in Python; commands in backticks stay as they are.

    Example:
        >>> python_words("--target-mesh face.obj: no such file; see `facediff export --help`")
        'target_mesh face.obj: no such file; see `facediff export --help`'
    """
    parts = message.split("`")
    parts[::2] = [_OWNER.sub("", _OPTION.sub(lambda found: found[1].replace("-", "_"), part)) for part in parts[::2]]
    return "`".join(parts)


def words_of(scales: Scales | None) -> str | None:
    """Numbers by name as the command line takes them.

    Example:
        >>> words_of({"lips": 0.5, "all": 1}), words_of(1.2), words_of(None)
        ('lips=0.5,all=1.0', '1.2', None)
    """
    if scales is None or isinstance(scales, str):
        return scales
    if isinstance(scales, Mapping):
        return ",".join(f"{name}={_number(value)}" for name, value in scales.items())
    return _number(scales)


def _number(value: object) -> str:
    """A number in words; anything else as it is, since the reader of the words refuses it by name."""
    return repr(float(value)) if isinstance(value, int | float) and not isinstance(value, bool) else str(value)
