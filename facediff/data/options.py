"""What the options of data modules have in common."""

from __future__ import annotations

from pathlib import Path

from facediff.data.corpus import read_manifest
from facediff.errors import FaceDiffError


def person_name(folder: Path) -> str:
    """Whose folder it is, as ``facediff data import-person`` wrote it.

    Raises:
        FaceDiffError: if it is no such folder.
    """
    name = read_manifest(folder).get("person")
    if not isinstance(name, str):
        raise FaceDiffError(
            f"data.people: {folder} is no person's folder (its manifest.json names none); make one with "
            f"`facediff data import-person`"
        )
    return name


def check_positive(**values: int | None) -> None:
    """Refuse numbers below one.

    Raises:
        FaceDiffError: naming the argument.
    """
    for name, value in values.items():
        if value is not None and value < 1:
            raise FaceDiffError(f"data.{name}: is {value}, expected a whole number above zero")
