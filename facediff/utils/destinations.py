"""Outputs that are refused before they are written: onto an input, onto each other, or onto what is no regular file."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from facediff.errors import FaceDiffError

DATA_SUFFIXES = frozenset(
    [".npy", ".npz", ".pkl", ".txt", ".yaml", ".hdf5", ".h5", ".ckpt", ".obj", ".ply", ".glb", ".gltf", ".wav", ".flac"]
    + [".ogg", ".mp3", ".aiff", ".aif"]
)
"""Files of a folder that is read are of these kinds, as a rule; pictures, pages and tables in it are results."""
RECORDS = frozenset(["manifest.json", "prepare.json", "metrics.csv"])
"""Files of a folder that is read which are data by their name."""


def destination(path: Path) -> Path:
    """The file or folder that a name leads to, through links; it need not exist."""
    with suppress(FileNotFoundError, NotADirectoryError):
        mode = path.stat().st_mode
        if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):
            raise FaceDiffError(f"{path}: cannot be written, since it is a device or a pipe; give the name of a file")
    return Path(os.path.realpath(path))


# A file that a command reads is never overwritten by it.

_read: dict[Path, Path] = {}
"""The inputs of the running command as they were named, by their place after all links."""


@contextmanager
def reading(inputs: Iterable[Path] = ()) -> Iterator[None]:
    """Protect the files that a command reads, as long as the block runs; :func:`protect` adds more."""
    before = dict(_read)
    try:
        protect(inputs)
        yield
    finally:
        _read.clear()
        _read.update(before)


def protect(inputs: Iterable[Path]) -> None:
    """Let :func:`refuse_protected` refuse these files and folders until the block of :func:`reading` ends."""
    _read.update((Path(os.path.realpath(path)), path) for path in inputs)


def refuse_protected(path: Path, *, folder: bool = False) -> None:
    """Refuse to overwrite a file that is being read, under whatever name; for a folder, one that holds such a file."""
    place = Path(os.path.realpath(path))
    if place in _read and place.exists():
        raise FaceDiffError(_refusal(path, _read[place]))
    inside = next((source for where, source in _read.items() if place in where.parents), None)
    if folder and inside is not None:
        raise FaceDiffError(f"{path}: would be replaced, and {inside} in it is read; choose another output")


def refuse_overwriting(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse outputs that are inputs, also through a link or as data in a folder that is read."""
    sources = {Path(os.path.realpath(path)): path for path in inputs}
    for path in outputs:
        place = Path(os.path.realpath(path))
        if place in sources and place.exists():
            raise FaceDiffError(_refusal(path, sources[place]))
        is_data = place.suffix.lower() in DATA_SUFFIXES or place.name in RECORDS or place.parent.name == "phonemes"
        around = next((sources[folder] for folder in place.parents if folder in sources), None)
        if is_data and around is not None and place.is_file():
            raise FaceDiffError(
                f"{path}: lies in {around}, which is read by this command, and would be overwritten; choose another "
                f"output, or remove this file first"
            )


def refuse_equal(outputs: Iterable[Path]) -> None:
    """Refuse two outputs that are one file."""
    places: dict[str, Path] = {}
    for path in outputs:
        if places.setdefault(os.path.realpath(path), path) is not path:
            raise FaceDiffError(f"{path}: is named for two outputs, of which one would overwrite the other")


def _refusal(path: Path, source: Path) -> str:
    also = "" if os.fspath(path) == os.fspath(source) else f" as {source}"
    return f"{path}: is read by this command{also} and would be overwritten; choose another output"
