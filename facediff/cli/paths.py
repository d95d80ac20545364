"""Files and folders of a command line: which are read, which are written, and what is refused before any work.

Every option and argument that is a path says so (:class:`facediff.utils.option.Option`); the checks here are the same
for all commands. What a command finds out later, such as the names of further files, is checked by the same rules where
it is written (:mod:`facediff.utils.files`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from facediff.errors import FaceDiffError
from facediff.utils.files import check_folder_writable, check_writable
from facediff.utils.option import Option
from facediff.utils.output_paths import protect, refuse_equal, refuse_overwriting


class Parameter(Protocol):
    """What a check needs to know of a command's parameter, which facediff.cli.parsing reads from a signature."""

    @property
    def name(self) -> str:
        """Its name in Python."""

    @property
    def option(self) -> Option:
        """Whether it is read or written, and how it is called."""

    @property
    def flag(self) -> str:
        """How it is given on the command line."""

    @property
    def is_path(self) -> bool:
        """Whether its values are paths, and not texts that may be one."""


def check_paths(parameters: Sequence[Parameter], values: Mapping[str, Any]) -> None:
    """Refuse, before any work is done, files that cannot be read or written, and outputs that are inputs.

    The inputs are protected from then on: nothing that the command writes replaces one of them.

    Args:
        parameters: of the command.
        values: what was given for them, by name.
    """
    inputs: list[Path] = []
    outputs: list[Path] = []
    for parameter in parameters:
        option = parameter.option
        for path in given_paths(parameter, values.get(parameter.name)):
            try:
                written = option.writes and not (option.reads and path.exists())
                if str(path) == "-" and (written or option.dash):
                    if not option.dash:
                        raise FaceDiffError("-: is not standard output here; expected the name of a file")
                elif option.suffixes and path.suffix.lower() not in option.suffixes:
                    raise FaceDiffError(f"{path}: expected a name that ends in {' or '.join(option.suffixes)}")
                elif written:
                    check_output(option, path)
                    outputs.append(path)
                elif parameter.is_path or path.exists():  # a text may be a name, or a path
                    check_input(option, path)
                    inputs.append(path)
            except (FaceDiffError, OSError) as error:
                reason = f"{path}: {error.strerror}" if isinstance(error, OSError) else error
                raise FaceDiffError(f"{parameter.flag} {reason}") from error
    refuse_equal(outputs)
    refuse_overwriting(inputs, outputs)
    protect(inputs)


def given_paths(parameter: Parameter, value: Any) -> Iterator[Path]:  # noqa: ANN401
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


def check_output(option: Option, path: Path) -> None:
    """Refuse a file or a folder that cannot be written, or has content that would be mixed with what is written."""
    if option.new and path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise FaceDiffError(f"{path}: exists already; choose another folder, or remove it")
    if option.writes == "folder" or (option.writes == "file or folder" and path.is_dir()):
        check_folder_writable(path)
    else:
        check_writable(path)


def check_input(option: Option, path: Path) -> None:
    """Refuse what is neither a file nor a folder, or not there although it must be."""
    present = {"file": path.is_file, "folder": path.is_dir}.get(option.exists, path.exists)()
    if option.exists and not present:
        raise FaceDiffError(f"{path}: no such {option.exists}")
    if path.exists() and not path.is_file() and not path.is_dir():
        raise FaceDiffError(f"{path}: is a device or a pipe; expected a file, or a folder of files")
    if path.exists() and not os.access(path, os.R_OK):
        raise FaceDiffError(f"{path}: cannot be read (permission denied)")
