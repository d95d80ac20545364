"""Names of files: from the user's home, which shells leave in ``--output=~/o.npz``, and in either form of Unicode."""

from __future__ import annotations

import os
import re
import unicodedata
from pathlib import Path
from typing import TypeVar

Value = TypeVar("Value")

_HOME = re.compile(r"(?:(?<=[=,:>])|^)~[\w.-]*(?=/|$)")


def from_home(value: Value) -> Value:
    """A path, or a text with paths, in which ``~`` is the user's home; anything else as it is."""
    if not isinstance(value, str | Path) or "~" not in str(value):
        return value
    text = _HOME.sub(lambda home: os.path.expanduser(home[0]), str(value))  # noqa: PTH111 - "~name" may be no user
    return type(value)(text)


# A letter with an accent has two forms in Unicode: macOS writes names of files in the decomposed one, all others in the
# composed one, which is the form of every name here.


def compose(name: str) -> str:
    """A name in the composed form."""
    return unicodedata.normalize("NFC", name)


def name_of_file(path: Path) -> str:
    """A file's name without its suffix, in the composed form."""
    return compose(path.stem)


def find_file(path: Path) -> Path:
    """The file of this name in either form; the path itself where there is none."""
    forms = (path, *(path.with_name(unicodedata.normalize(form, path.name)) for form in ("NFC", "NFD")))
    return next((form for form in forms if form.exists()), path)
