"""Files and folders of a command line: which are read, which are written, and what is refused before any work.

Every option and argument that is a path says so (:class:`facediff.cli.parsing.Option`); the checks here are the same
for all commands. What a command finds out later, such as the names of further files, is checked by the same rules where
it is written (:mod:`facediff.utils.files`).
"""

from __future__ import annotations

import errno
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from facediff.errors import FaceDiffError
from facediff.utils.destinations import protect, refuse_equal, refuse_overwriting
from facediff.utils.files import check_folder_writable, check_writable
from facediff.utils.option import Option


class PathParameter(Protocol):
    """What the checks read of a :class:`facediff.cli.parsing.Parameter`."""

    @property
    def name(self) -> str:
        """Name of the value."""

    @property
    def option(self) -> Option:
        """Whether a path is read or written."""

    @property
    def is_path(self) -> bool:
        """Whether a value is a path; texts may hold one as well."""

    @property
    def shown(self) -> str:
        """The name as errors show it."""


def check_paths(parameters: Sequence[PathParameter], values: Mapping[str, Any]) -> None:
    """Refuse, before any work is done, files that cannot be read or written, and outputs that are inputs.

    The inputs are protected from then on: nothing that the command writes replaces one of them.

    Args:
        parameters: of the command.
        values: what was given for them, by name.
    """
    inputs: list[Path] = []
    outputs: list[Path] = []
    for parameter in parameters:
        for path in given_paths(parameter, values.get(parameter.name)):
            written = parameter.option.writes and not (parameter.option.reads and path.exists())
            if str(path) == "-" and (written or parameter.option.dash):
                check_dash(parameter)
            elif written:
                check_output(parameter, path)
                outputs.append(path)
            elif parameter.is_path or path.exists():  # a text may be a name, or a path
                check_input(parameter, path)
                inputs.append(path)
    refuse_equal(outputs)
    refuse_overwriting(inputs, outputs)
    protect(inputs)


def given_paths(parameter: PathParameter, value: Any) -> Iterator[Path]:  # noqa: ANN401
    """The paths in a value; in a text, such as ``NAME=FOLDER`` or ``a.npy:0.3,b.npy:0.7``, all that may be one."""
    option = parameter.option
    if value is None or not (parameter.is_path or option.reads or option.writes):
        return
    for entry in value if isinstance(value, list | tuple) else [value]:
        if isinstance(entry, Path):
            yield entry
        elif isinstance(entry, str) and option.writes:
            yield Path(entry)
        elif isinstance(entry, str):
            parts = [entry, *entry.split(",")]
            parts += [part.partition("=")[2] for part in parts]
            parts += [re.split(r"[:>]", part)[0] for part in parts]
            yield from (Path(part) for part in dict.fromkeys(parts) if part and exists(part))


def exists(text: str) -> bool:
    """Whether a text is the path of something; no text is too long for that."""
    try:
        return os.path.lexists(text)
    except (OSError, ValueError):
        return False


def check_dash(parameter: PathParameter) -> None:
    """Refuse ``-`` for standard output where a command does not write to it."""
    if not parameter.option.dash:
        raise FaceDiffError(
            f"{parameter.shown} -: is standard output elsewhere, but not here; expected the name of a file"
        )


def check_output(parameter: PathParameter, path: Path) -> None:
    """Refuse a file or a folder that cannot be written."""
    kind = parameter.option.writes
    try:
        if kind == "folder" or (kind == "file or folder" and path.is_dir()):
            check_folder_writable(path)
        else:
            check_writable(path)
    except (FaceDiffError, OSError) as error:
        reason = f"{path}: {error.strerror}" if isinstance(error, OSError) else error
        raise FaceDiffError(f"{parameter.shown} {reason}") from error


def check_input(parameter: PathParameter, path: Path) -> None:
    """Refuse a name that no file can have, and what is neither file nor folder; missing files are reported later."""
    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError):
        return
    except OSError as error:
        what = "links lead to each other" if error.errno == errno.ELOOP else error.strerror
        raise FaceDiffError(f"{parameter.shown} {path}: cannot be read ({what})") from error
    if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
        raise FaceDiffError(f"{parameter.shown} {path}: is a device or a pipe; expected a file, or a folder of files")
    if not os.access(path, os.R_OK):
        raise FaceDiffError(f"{parameter.shown} {path}: cannot be read (permission denied)")
