"""Finding and copying files of a raw folder, which may hold the data set or the folder that an archive unpacked to."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.files import atomic


def bases(raw: Path) -> list[Path]:
    """The raw folder and the folders in it, sorted: places where a data set may begin.

    Raises:
        FaceDiffError: if there is no such folder or it cannot be read.
    """
    if not raw.is_dir():
        raise FaceDiffError(f"{raw}: no such folder; expected the raw data set as it was distributed")
    return [raw, *folders_in(raw)]


def folders_in(folder: Path) -> list[Path]:
    """Folders in a folder, sorted, without hidden ones.

    Raises:
        FaceDiffError: if it cannot be read.
    """
    try:
        return sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith("."))
    except OSError as error:
        raise FaceDiffError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from error


def find_file(raw: Path, name: str) -> Path | None:
    """A file of this name in the raw folder or one folder deeper; None if there is none."""
    return next((path for base in bases(raw) if (path := base / name).is_file()), None)


def find_regions(raw: Path, given: Path | None) -> Path | None:
    """The folder with the lists of vertices: the one given, else ``regions/`` of the raw folder if there is one.

    Raises:
        FaceDiffError: if the one given is no folder or holds no list.
    """
    if given is None:
        return next((path for base in bases(raw) if (path := base / "regions").is_dir()), None)
    if not region_files(given):
        raise FaceDiffError(f"{given}: expected a folder with lists of vertices, e.g. lve.txt and fdd.txt")
    return given


def region_files(folder: Path | None) -> list[Path]:
    """The lists of vertices in a folder."""
    return [] if folder is None else sorted(path for path in folder.glob("*.txt") if path.is_file())


def copy_files(sources: Sequence[Path], out: Path, folder: str = "") -> list[str]:
    """Copy files into the output folder (or a folder in it) under their own names; returns their relative paths."""
    written = []
    for source in sources:
        target = out / folder / source.name
        with atomic(target) as temporary:
            shutil.copyfile(source, temporary)
        written.append(target.relative_to(out).as_posix())
    return written
