"""Outputs that are refused before they are written: onto an input, onto each other, or onto a device."""

from __future__ import annotations

import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from facediff.errors import FaceDiffError
from facediff.utils.paths import from_home

DATA_SUFFIXES = frozenset(
    [".npy", ".npz", ".pkl", ".txt", ".yaml", ".hdf5", ".h5", ".ckpt", ".obj", ".ply", ".glb", ".gltf", ".wav", ".flac"]
    + [".ogg", ".mp3", ".aiff", ".aif"]
)
"""Files of a folder that is read are of these kinds, as a rule; pictures, pages and tables in it are results."""
RECORDS = frozenset(["manifest.json", "prepare.json", "metrics.csv"])
"""Files of a folder that is read which are data by their name."""


def destination(path: Path) -> Path:
    """The file or folder that a name leads to, through links and from the user's home; it need not exist."""
    path = from_home(path)
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
    """Refuse to overwrite a file that is being read, under any name; for a folder, one that holds such a file."""
    target = Path(os.path.realpath(path))
    inside = next((source for where, source in _read.items() if folder and target in where.parents), None)
    source = _read.get(target) if target.exists() else None
    if source is not None or inside is not None:
        raise _refusal(path, source or inside)


def refuse_overwriting(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse outputs that are inputs, also through a link or as data in a folder that is read."""
    sources = {Path(os.path.realpath(path)): path for path in inputs}
    for path in outputs:
        target = Path(os.path.realpath(path))
        is_data = target.suffix.lower() in DATA_SUFFIXES or target.name in RECORDS or target.parent.name == "phonemes"
        folders = target.parents if is_data and target.is_file() else ()
        if target.exists() and (source := next((sources[p] for p in (target, *folders) if p in sources), None)):
            raise _refusal(path, source)


def refuse_equal(outputs: Iterable[Path]) -> None:
    """Refuse two outputs that are one file."""
    targets: dict[str, Path] = {}
    for path in outputs:
        if targets.setdefault(os.path.realpath(path), path) is not path:
            raise FaceDiffError(f"{path}: is named for two outputs, of which one would overwrite the other")


def _refusal(path: Path, source: Path | None) -> FaceDiffError:
    return FaceDiffError(f"{path}: would be overwritten, but this command reads {source}; choose another output")
