"""Files and folders of a command line: which are read, which are written, and which are refused before any work.

Every option and argument that is a path says so (:class:`facediff.utils.option.Option`); the checks here are the same
for all commands. Files with names that a command finds later are checked where they are written
(:mod:`facediff.utils.files`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol, cast

from facediff.errors import FaceDiffError
from facediff.utils.files import check_folder_writable, check_writable
from facediff.utils.option import Option
from facediff.utils.output_paths import protect, refuse_equal, refuse_overwriting


class PathParameter(Protocol):
    """The parts of a command's parameter that checks read (:mod:`facediff.cli.parsing` makes it)."""

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


def check_paths(parameters: Sequence[PathParameter], values: Mapping[str, Any]) -> None:
    """Refuse, before any work is done, files that cannot be read or written, and outputs that are inputs.

    The inputs are protected from then on: no output of the command replaces one of them.
    """
    inputs: list[Path] = []
    outputs: list[Path] = []
    for parameter in parameters:
        option = parameter.option
        for path in given_paths(parameter, values.get(parameter.name)):
            problem, cause = "", cast(Exception | None, None)
            try:
                written = option.writes and not (option.reads and path.exists())
                if str(path) == "-" and (written or option.dash):
                    problem = "" if option.dash else "is not standard output here; expected the name of a file"
                elif option.suffixes and path.suffix.lower() not in option.suffixes:
                    problem = f"expected a name that ends in {' or '.join(option.suffixes)}"
                elif written:
                    problem = output_problem(option, path)
                    outputs.append(path)
                elif parameter.is_path or path.exists():  # a text may be a name, or a path
                    problem = input_problem(option, path)
                    inputs.append(path)
            except FaceDiffError as error:
                problem, cause = str(error).removeprefix(f"{path}: "), error
            except OSError as error:
                problem, cause = str(error.strerror), error
            if problem:
                raise FaceDiffError(f"{parameter.flag} {path}: {problem}") from cause
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
    """Whether a text is the path of a file or folder; no text is too long for that."""
    try:
        return os.path.lexists(text)
    except (OSError, ValueError):
        return False


def output_problem(option: Option, path: Path) -> str:
    """Why a file or a folder cannot be written; empty if it can."""
    if option.new and path.exists() and (not path.is_dir() or any(path.iterdir())):
        return "exists already; choose another folder, or remove it"
    if option.writes == "folder" or (option.writes == "file or folder" and path.is_dir()):
        check_folder_writable(path)
    else:
        check_writable(path)
    return ""


def input_problem(option: Option, path: Path) -> str:
    """Why a file or a folder cannot be read; empty if it can."""
    present = {"file": path.is_file, "folder": path.is_dir}.get(option.exists, path.exists)()
    if option.exists and not present:
        return f"no such {option.exists}"
    if path.exists() and not path.is_file() and not path.is_dir():
        return "is a device or a pipe; expected a file, or a folder of files"
    return "cannot be read (permission denied)" if path.exists() and not os.access(path, os.R_OK) else ""
