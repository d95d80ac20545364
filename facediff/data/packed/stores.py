"""Byte access to a packed corpus in a folder or at any address that fsspec knows."""

from __future__ import annotations

import os
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from facediff.data.packed.layout import DAMAGED, METADATA, STATE
from facediff.errors import FaceDiffError, damaged, needs_extra

ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::|://)")

ByteRange = tuple[int, int]
"""First byte and number of bytes."""


def address_of(source: str | Path) -> str | None:
    """The address in a text, or in a path made of one; None for a path of this machine.

    Example:
        >>> address_of("https://lab.example/biwi.zarr"), address_of("data/biwi.zarr")
        ('https://lab.example/biwi.zarr', None)
        >>> address_of(Path("s3://bucket/biwi.zarr"))
        's3://bucket/biwi.zarr'
    """
    text = str(source)
    if isinstance(source, Path):  # which makes one slash of two
        text = re.sub(r"^([A-Za-z][A-Za-z0-9+.-]+):/(?!/)", r"\1://", text)
    return text if ADDRESS.match(text) else None


def is_packed(source: str | Path) -> bool:
    """Whether a corpus is packed: an address, or a folder with the metadata of Zarr or the state of a packing."""
    if address_of(source) is not None:
        return True
    folder = Path(source).expanduser()
    return (folder / METADATA).is_file() or (folder / STATE).is_file()


class ByteStore(ABC):
    """Bytes by key.

    Args:
        source: the folder or the address, as messages name it.
    """

    def __init__(self, source: str) -> None:
        self.source = source

    @abstractmethod
    def read(self, key: str, start: int | None = None, stop: int | None = None) -> bytes:
        """Bytes of an object, all of them by default."""

    def whole(self, key: str) -> bytes:
        """All bytes of a small object."""
        return self.read(key)

    def ranges(self, key: str, byte_ranges: Sequence[ByteRange]) -> list[memoryview]:
        """Ranges of an object, those that follow one another by one read or request."""
        parts: list[memoryview] = []
        for run in runs(byte_ranges):
            parts += split(self.read(key, run[0][0], sum(run[-1])), run, f"{self.source}/{key}")
        return parts


def open_store(source: str | Path) -> ByteStore:
    """The store of a packed corpus: a folder, or an address."""
    address = address_of(source)
    return LocalStore(Path(source).expanduser()) if address is None else RemoteStore(address.rstrip("/"))


class LocalStore(ByteStore):
    """A packed corpus in a folder."""

    def __init__(self, root: Path) -> None:
        super().__init__(str(root))
        self.root = root

    def read(self, key: str, start: int | None = None, stop: int | None = None) -> bytes:
        """Bytes of a file."""
        path = self.root / key
        with damaged(f"{path}: cannot be read", DAMAGED, OSError), path.open("rb", buffering=0) as stream:
            stream.seek(start or 0)
            return stream.read(-1 if stop is None else stop - stream.tell())


class RemoteStore(ByteStore):
    """A packed corpus at an address, as fsspec has it."""

    def __init__(self, address: str) -> None:
        super().__init__(address)
        self._system: Any = None
        self._process = 0
        self._base = ""

    def __getstate__(self) -> dict[str, Any]:
        """Leave out connections, which belong to their process."""
        return {**self.__dict__, "_system": None}

    def read(self, key: str, start: int | None = None, stop: int | None = None) -> bytes:
        """Bytes of an object."""
        remedy = "check the address, the connection and your access to it, and install the package that fsspec names"
        # Every file system has its own exceptions.
        with damaged(f"{self.source}/{key}: cannot be read", remedy, Exception):
            content: bytes = self._connected().cat_file(f"{self._base}/{key}", start=start, end=stop)
        return content

    def _connected(self) -> Any:  # noqa: ANN401 - fsspec has no types
        # A connection belongs to the process that made it: loader processes, forks of this one, make their own.
        if self._system is None or self._process != os.getpid():
            with needs_extra("fsspec", "packed", "reading a corpus from an address"):
                import fsspec
            self._system, self._base = fsspec.core.url_to_fs(self.source, skip_instance_cache=True)
            self._process = os.getpid()
        return self._system


def runs(byte_ranges: Sequence[ByteRange]) -> list[list[ByteRange]]:
    """Groups of adjacent ranges, each fetched by one read or request.

    Example:
        >>> runs([(0, 4), (4, 2), (9, 1)])
        [[(0, 4), (4, 2)], [(9, 1)]]
    """
    groups: list[list[ByteRange]] = []
    for byte_range in byte_ranges:
        if groups and sum(groups[-1][-1]) == byte_range[0]:
            groups[-1].append(byte_range)
        else:
            groups.append([byte_range])
    return groups


def split(content: bytes, run: Sequence[ByteRange], source: object) -> list[memoryview]:
    """The bytes of a run of ranges, one view for each."""
    if len(content) != sum(size for _, size in run):
        raise FaceDiffError(
            f"{source}: gave {len(content)} bytes instead of {sum(size for _, size in run)} from byte {run[0][0]} on; "
            f"it is cut short, or the server does not answer requests for ranges"
        )
    view = memoryview(content)
    return [view[start - run[0][0] : start - run[0][0] + size] for start, size in run]
