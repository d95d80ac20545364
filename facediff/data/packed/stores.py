"""Byte access to a packed corpus in a folder or at any address that fsspec knows, with a cache on disk.

fsspec's own block cache has no limit, and asks a server for the size of every object before it reads.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from facediff.data.packed.layout import DAMAGED, METADATA, STATE
from facediff.errors import FaceDiffError, damaged, needs_extra
from facediff.utils.files import atomic, cache_dir
from facediff.utils.ranges import Range

VARIABLE = "FACEDIFF_PACKED_CACHE_GB"
USUAL_GB = 50.0
"""Default size of the cache in gigabytes."""
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


class ByteStore(Protocol):
    """Bytes by key."""

    source: str

    def whole(self, key: str) -> bytes:
        """All bytes of a small object."""

    def ranges(self, key: str, byte_ranges: Sequence[ByteRange]) -> list[memoryview]:
        """Some ranges of an object."""


def open_store(source: str | Path) -> LocalStore | RemoteStore:
    """The store of a packed corpus: a folder, or an address, of which nothing is cached yet."""
    address = address_of(source)
    return LocalStore(Path(source).expanduser()) if address is None else RemoteStore(address, None)


class LocalStore:
    """A packed corpus on a disk.

    Args:
        root: its folder.
    """

    def __init__(self, root: Path) -> None:
        self.root = root
        self.source = str(root)

    def whole(self, key: str) -> bytes:
        """All bytes of a file."""
        path = self.root / key
        with damaged(f"{path}: cannot be read", DAMAGED, OSError):
            return path.read_bytes()

    def ranges(self, key: str, byte_ranges: Sequence[ByteRange]) -> list[memoryview]:
        """Ranges of a file, those that follow one another in one read."""
        path = self.root / key
        parts: list[memoryview] = []
        with damaged(path, DAMAGED, OSError), path.open("rb", buffering=0) as stream:
            for run in runs(byte_ranges):
                stream.seek(run[0][0])
                parts += split(stream.read(sum(size for _, size in run)), run, path)
        return parts


class RemoteStore:
    """A packed corpus at an address; ranges that were read once come from a cache on disk.

    Args:
        address: of the group, as fsspec has it.
        cache: folder for the ranges, one file each; None for no cache.
    """

    def __init__(self, address: str, cache: Path | None) -> None:
        self.source = address.rstrip("/")
        self.cache = cache
        self._system: Any = None
        self._process = 0
        self._base = ""

    def __getstate__(self) -> dict[str, Any]:
        """Leave out connections, which belong to their process."""
        return {**self.__dict__, "_system": None}

    def whole(self, key: str) -> bytes:
        """All bytes of an object."""
        return self._fetch(key, None, None)

    def ranges(self, key: str, byte_ranges: Sequence[ByteRange]) -> list[memoryview]:
        """Ranges of an object: from the cache, or fetched, with neighbours in one request."""
        parts = {byte_range: part for byte_range in byte_ranges if (part := self._cached(key, byte_range)) is not None}
        for run in runs([byte_range for byte_range in dict.fromkeys(byte_ranges) if byte_range not in parts]):
            content = self._fetch(key, run[0][0], sum(run[-1]))
            for byte_range, part in zip(run, split(content, run, f"{self.source}/{key}"), strict=True):
                parts[byte_range] = part
                self._keep(key, byte_range, part)
        return [parts[byte_range] for byte_range in byte_ranges]

    def _file(self, folder: Path, key: str, byte_range: ByteRange) -> Path:
        return folder / key.replace("/", ".") / f"{byte_range[0]}-{byte_range[1]}"

    def _cached(self, key: str, byte_range: ByteRange) -> memoryview | None:
        if self.cache is None:
            return None
        try:
            content = self._file(self.cache, key, byte_range).read_bytes()
        except OSError:
            return None
        return memoryview(content) if len(content) == byte_range[1] else None

    def _keep(self, key: str, byte_range: ByteRange, content: memoryview) -> None:
        if self.cache is not None:
            try:
                with atomic(self._file(self.cache, key, byte_range)) as temporary:
                    temporary.write_bytes(content)
            except FaceDiffError:  # a full or protected disk: reading goes on without
                self.cache = None

    def _fetch(self, key: str, start: int | None, end: int | None) -> bytes:
        remedy = "check the address, the connection and your access to it, and install the package that fsspec names"
        # Every file system has its own exceptions.
        with damaged(f"{self.source}/{key}: cannot be read", remedy, Exception):
            content: bytes = self._connected().cat_file(f"{self._base}/{key}", start=start, end=end)
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


def cache_folder(identity: str, size: int) -> Path | None:
    """The folder for the ranges of a packed corpus at an address; None for one that is larger than the limit.

    The corpora that were not opened for the longest time are removed until this one fits.
    """
    limit, folder = limit_bytes(VARIABLE, USUAL_GB), cache_dir() / "packed" / identity / "chunks"
    if size > limit:
        return None
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        os.utime(folder)
        caches = sorted(folder.parents[1].glob("*/chunks"), key=lambda cache: cache.stat().st_mtime)
        sizes = {cache: sum(file.stat().st_size for file in cache.rglob("*") if file.is_file()) for cache in caches}
        total = sum(sizes.values()) - sizes[folder] + size
        for cache in caches:
            if total > limit and cache != folder:
                shutil.rmtree(cache, ignore_errors=True)
                total -= sizes[cache]
    return folder


def limit_bytes(variable: str, default: float) -> float:
    """Size limit of a cache in bytes: gigabytes of an environment variable, or else the default; 0 keeps nothing."""
    return 1e9 * Range(0, 1e9).read(variable, os.environ.get(variable, str(default)))
