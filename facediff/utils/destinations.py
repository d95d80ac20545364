"""Where a name leads that is given as output: through links, to a device, a pipe or a descriptor; never onto an input.

Everything here is looked up again at the moment of writing, since it may have changed since the arguments were checked.
"""

from __future__ import annotations

import errno
import os
import re
import shutil
import stat
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from facediff.errors import FaceDiffError

MAX_LINKS = 40
READER_WITHIN = 20.0
"""Seconds that a named pipe is given for somebody to read from it."""
DATA_SUFFIXES = frozenset(
    [".npy", ".npz", ".pkl", ".txt", ".yaml", ".hdf5", ".h5", ".ckpt", ".obj", ".ply", ".glb", ".gltf", ".wav", ".flac"]
    + [".ogg", ".mp3", ".aiff", ".aif"]
)
"""Files of a folder that is read are of these kinds, as a rule; pictures, pages and tables in it are results."""
RECORDS = frozenset(["manifest.json", "prepare.json", "metrics.csv"])
"""Files of a folder that is read which are data by their name."""


@dataclass(frozen=True)
class Destination:
    """Where a name leads.

    Attributes:
        path: the place after all links.
        descriptor: the number of an open descriptor of this process, where the name stands for one (``/dev/stdout``).
        special: whether bytes go there that replace nothing: to a device, a pipe or a descriptor.
    """

    path: Path
    descriptor: int | None = None
    special: bool = False

    def open(self) -> IO[bytes]:
        """Open a special destination for writing.

        Raises:
            OSError: if it does not take bytes; also if nobody reads from a pipe for some time.
        """
        if self.descriptor is not None:
            # Opening the name again would start at the beginning of a file that the shell has redirected to.
            return os.fdopen(os.dup(self.descriptor), "wb")
        if not stat.S_ISFIFO(self.path.stat().st_mode):
            return self.path.open("wb")
        patience = time.monotonic() + READER_WITHIN
        while True:
            try:
                opened = os.open(self.path, os.O_WRONLY | os.O_NONBLOCK)
            except OSError as error:
                if error.errno != errno.ENXIO:
                    raise
                if time.monotonic() > patience:
                    raise OSError(errno.ENXIO, "nobody reads from this pipe", str(self.path)) from error
                time.sleep(0.05)
            else:
                os.set_blocking(opened, True)
                return os.fdopen(opened, "wb")

    def receive(self, source: Path) -> None:
        """Write the bytes of a file to a special destination."""
        with source.open("rb") as stream, self.open() as target:
            shutil.copyfileobj(stream, target)


def destination(path: Path) -> Destination:
    """Where a name leads; what it leads to need not exist.

    Raises:
        OSError: if links lead to each other, or the name cannot be looked up.
    """
    current = os.fspath(path)
    for _ in range(MAX_LINKS):
        folder, name = os.path.split(current)
        if name in ("", ".", ".."):
            return Destination(Path(os.path.realpath(current)))
        current = os.path.join(os.path.realpath(folder or os.curdir), name)
        # Links of this kind are followed by the kernel to the open file itself; as a path they lead past it.
        found = re.fullmatch(r"/proc/(\d+)(?:/task/\d+)?/fd/(\d+)", current)
        if found is not None and int(found[1]) == os.getpid():
            os.fstat(int(found[2]))
            return Destination(path, descriptor=int(found[2]), special=True)
        if not os.path.islink(current):
            break
        current = os.path.join(os.path.dirname(current), os.readlink(current))
    else:
        raise OSError(errno.ELOOP, os.strerror(errno.ELOOP), str(path))
    try:
        mode = os.stat(current).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return Destination(Path(current))
    return Destination(Path(current), special=not stat.S_ISREG(mode) and not stat.S_ISDIR(mode))


# A file that a command reads is never overwritten by it.

_read: dict[tuple[int, int], Path] = {}


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
    for path in inputs:
        with suppress(OSError):  # what is missing is reported where it is read
            _read[_identity(path)] = path


def refuse_protected(path: Path, *, folder: bool = False) -> None:
    """Refuse to overwrite a file that is being read, under whatever name; for a folder, one that holds such a file.

    Raises:
        FaceDiffError: naming the file.
    """
    with suppress(FileNotFoundError, NotADirectoryError):
        if (read := _read.get(_identity(path))) is not None and not _is_special(path):
            raise FaceDiffError(_refusal(path, read))
    if folder:
        place = os.path.realpath(path)
        for read in _read.values():
            if os.path.realpath(read).startswith(place + os.sep):
                raise FaceDiffError(f"{path}: would be replaced, and {read} in it is read; choose another output")


def refuse_overwriting(inputs: Iterable[Path], outputs: Iterable[Path]) -> None:
    """Refuse outputs that are inputs, also by another name, through a link or as data in a folder that is read.

    Raises:
        FaceDiffError: naming the file.
    """
    files: dict[tuple[int, int], Path] = {}
    folders: dict[str, Path] = {}
    for path in inputs:
        with suppress(OSError):
            files[_identity(path)] = path
            if path.is_dir():
                folders[os.path.realpath(path)] = path
    for path in outputs:
        try:
            own = _identity(path)
        except OSError:  # nothing is there that could be overwritten
            continue
        if own in files and not _is_special(path):
            raise FaceDiffError(_refusal(path, files[own]))
        place = Path(os.path.realpath(path))
        is_data = place.suffix.lower() in DATA_SUFFIXES or place.name in RECORDS or place.parent.name == "phonemes"
        around = next((folders[str(each)] for each in place.parents if str(each) in folders), None)
        if is_data and around is not None and place.is_file():
            raise FaceDiffError(
                f"{path}: lies in {around}, which is read by this command, and would be overwritten; choose another "
                f"output, or remove this file first"
            )


def refuse_equal(outputs: Iterable[Path]) -> None:
    """Refuse two outputs that are one file; devices and pipes take both.

    Raises:
        FaceDiffError: naming the file.
    """
    found: dict[str, Path] = {}
    for path in outputs:
        with suppress(OSError):
            where = destination(path)
            if where.special:
                continue
            other = found.setdefault(os.path.realpath(where.path), path)
            if other is not path:
                raise FaceDiffError(f"{path}: is named for two outputs, of which one would overwrite the other")


def _refusal(path: Path, read: Path) -> str:
    also = "" if os.fspath(path) == os.fspath(read) else f" as {read}"
    return f"{path}: is read by this command{also} and would be overwritten; choose another output"


def _identity(path: Path) -> tuple[int, int]:
    status = path.stat()
    return status.st_dev, status.st_ino


def _is_special(path: Path) -> bool:
    mode = path.stat().st_mode
    return not stat.S_ISREG(mode) and not stat.S_ISDIR(mode)
