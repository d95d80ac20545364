"""Byte access to a packed corpus in a folder or at any address that fsspec knows, with a cache on disk."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

from facediff.data.packed.layout import DAMAGED, METADATA, STATE
from facediff.data.packed.web import WebServer
from facediff.errors import FaceDiffError, needs_extra
from facediff.utils.files import atomic, cache_dir
from facediff.utils.limits import brief

VARIABLE = "FACEDIFF_PACKED_CACHE_GB"
USUAL_GB = 50.0
"""Default size of the cache in gigabytes."""
TOUCHED = 3600.0
"""Seconds after which reading a kept chunk marks it as used; marking it each time would cost a write each time."""
ADDRESS = re.compile(r"[A-Za-z][A-Za-z0-9+.-]*(::|://)")

Range = tuple[int, int]
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
    """Whether a corpus is packed: an address, or a folder with the metadata of Zarr (or whose packing has begun)."""
    if address_of(source) is not None:
        return True
    folder = Path(source).expanduser()
    return (folder / METADATA).is_file() or (folder / STATE).is_file()


class ByteStore(Protocol):
    """Bytes by key."""

    source: str

    def whole(self, key: str) -> bytes:
        """All bytes of a small object."""

    def ranges(self, key: str, byte_ranges: Sequence[Range]) -> list[memoryview]:
        """Some ranges of an object."""


def open_store(source: str | Path, identity: str = "") -> ByteStore:
    """The store of a packed corpus.

    Args:
        source: folder or address.
        identity: key of the cache for an address; nothing is cached if empty.
    """
    address = address_of(source)
    if address is not None:
        return RemoteStore(address, None if not identity else ChunkCache(cache_dir() / "packed", identity))
    return LocalStore(Path(source).expanduser())


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
        try:
            return path.read_bytes()
        except OSError as error:
            raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {DAMAGED}") from error

    def ranges(self, key: str, byte_ranges: Sequence[Range]) -> list[memoryview]:
        """Ranges of a file, those that follow one another in one read."""
        path = self.root / key
        parts: list[memoryview] = []
        try:
            with path.open("rb", buffering=0) as stream:
                for run in runs(byte_ranges):
                    stream.seek(run[0][0])
                    parts += split(stream.read(sum(size for _, size in run)), run, path)
        except OSError as error:
            raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); {DAMAGED}") from error
        return parts


class RemoteStore:
    """A packed corpus at an address; ranges that were read once come from a cache on disk.

    Args:
        address: of the group, as fsspec has it.
        cache: of the ranges; None for no cache.
    """

    def __init__(self, address: str, cache: ChunkCache | None) -> None:
        self.source = address.rstrip("/")
        self.cache = cache
        self._web = WebServer(self.source) if WebServer.serves(self.source) else None
        self._system: Any = None
        self._process = 0
        self._base = ""

    def __getstate__(self) -> dict[str, Any]:
        """Leave out connections, which belong to their process."""
        return {**self.__dict__, "_system": None}

    def whole(self, key: str) -> bytes:
        """All bytes of an object."""
        return bytes(self._fetch(key, None, None))

    def ranges(self, key: str, byte_ranges: Sequence[Range]) -> list[memoryview]:
        """Ranges of an object: from the cache, or fetched, with neighbours in one request."""
        parts: dict[Range, memoryview] = {}
        for byte_range in dict.fromkeys(byte_ranges):
            cached = None if self.cache is None else self.cache.get(key, byte_range)
            if cached is not None:
                parts[byte_range] = cached
        for run in runs([byte_range for byte_range in dict.fromkeys(byte_ranges) if byte_range not in parts]):
            start, end = run[0][0], run[-1][0] + run[-1][1]
            for byte_range, part in zip(
                run, split(self._fetch(key, start, end), run, f"{self.source}/{key}"), strict=True
            ):
                parts[byte_range] = part
                if self.cache is not None:
                    self.cache.put(key, byte_range, part)
        return [parts[byte_range] for byte_range in byte_ranges]

    def _fetch(self, key: str, start: int | None, end: int | None) -> bytes | bytearray:
        where = f"{self.source}/{key}"
        try:
            answer = None if self._web is None else self._web.get(key, start, end)
        except FileNotFoundError as error:
            raise FaceDiffError(f"{where}: there is no such object; check the address") from error
        if answer is not None:
            return answer
        system = self._connected()
        try:
            content: bytes = system.cat_file(f"{self._base}/{key}", start=start, end=end)
        except FileNotFoundError as error:
            raise FaceDiffError(f"{where}: there is no such object; check the address") from error
        except Exception as error:  # every file system has its own exceptions
            raise FaceDiffError(
                f"{where}: cannot be read ({brief(error)}); check the address, the connection and your access to it"
            ) from error
        return content

    def _connected(self) -> Any:  # noqa: ANN401 - fsspec has no types
        # A connection belongs to the process that made it: loader processes, forks of this one, make their own.
        if self._system is None or self._process != os.getpid():
            with needs_extra("fsspec", "packed", "reading a corpus from an address"):
                import fsspec
            try:
                self._system, self._base = fsspec.core.url_to_fs(self.source, skip_instance_cache=True)
            except Exception as error:  # every file system asks for options of its own
                raise FaceDiffError(
                    f"{self.source}: cannot be opened ({brief(error)}); install what fsspec names, or correct the "
                    f"address"
                ) from error
            self._process = os.getpid()
        return self._system


def runs(byte_ranges: Sequence[Range]) -> list[list[Range]]:
    """Groups of adjacent ranges, which one read or request can fetch.

    Example:
        >>> runs([(0, 4), (4, 2), (9, 1)])
        [[(0, 4), (4, 2)], [(9, 1)]]
    """
    groups: list[list[Range]] = []
    for byte_range in byte_ranges:
        if groups and sum(groups[-1][-1]) == byte_range[0]:
            groups[-1].append(byte_range)
        else:
            groups.append([byte_range])
    return groups


def split(content: bytes | bytearray, run: Sequence[Range], source: object) -> list[memoryview]:
    """The bytes of a run of ranges, one view for each."""
    if len(content) != sum(size for _, size in run):
        raise FaceDiffError(
            f"{source}: gave {len(content)} bytes instead of {sum(size for _, size in run)} from byte {run[0][0]} on; "
            f"it is cut short, or the server does not answer requests for ranges"
        )
    view = memoryview(content)
    return [view[start - run[0][0] : start - run[0][0] + size] for start, size in run]


class ChunkCache:
    """A cache on disk for ranges read from addresses, one file each; the least recently used are removed.

    Several processes may use it at the same time; anything in it may be removed at any time.

    Args:
        folder: of all packed corpora.
        identity: of this one.
    """

    def __init__(self, folder: Path, identity: str) -> None:
        self.folder = folder
        self.identity = identity
        self.limit = limit_bytes(VARIABLE, USUAL_GB)
        # Scanning the folder is slow: it is done at first, and whenever a tenth of the limit was added.
        self._unseen = self.limit

    def _path(self, key: str, byte_range: Range) -> Path:
        return self.folder / self.identity / "chunks" / key.replace("/", ".") / f"{byte_range[0]}-{byte_range[1]}"

    def get(self, key: str, byte_range: Range) -> memoryview | None:
        """The bytes of a range; None if they are not in the cache."""
        if not self.limit:
            return None
        path = self._path(key, byte_range)
        try:
            content = path.read_bytes()
            if time.time() - path.stat().st_mtime > TOUCHED:
                os.utime(path)
        except OSError:
            return None
        return memoryview(content) if len(content) == byte_range[1] else None

    def put(self, key: str, byte_range: Range, content: memoryview) -> None:
        """Store the bytes of a range, if the disk has room."""
        if not self.limit:
            return
        try:
            with atomic(self._path(key, byte_range)) as temporary:
                temporary.write_bytes(content)
        except FaceDiffError:  # a full or protected disk: reading goes on without
            self.limit = 0.0
            return
        self._unseen += len(content)
        if self._unseen > self.limit / 10:
            self._unseen = 0.0
            self.trim()

    def trim(self) -> None:
        """Remove the files that were not used for the longest time, until nine tenths of the limit are left."""
        kept: list[tuple[float, int, str]] = []
        for folder, _, names in os.walk(self.folder):
            if Path(folder).parent.name == "chunks":
                for name in names:
                    try:
                        facts = os.stat(os.path.join(folder, name))
                    except OSError:  # another process has removed it
                        continue
                    kept.append((facts.st_mtime, facts.st_size, os.path.join(folder, name)))
        total = sum(size for _, size, _ in kept)
        if total <= self.limit:
            return
        for _, size, path in sorted(kept):
            if total <= 0.9 * self.limit:
                break
            Path(path).unlink(missing_ok=True)
            total -= size


def limit_bytes(variable: str, usual: float) -> float:
    """Size limit of a cache in bytes: an environment variable's gigabytes, or else the usual ones."""
    text = os.environ.get(variable, str(usual))
    try:
        limit = float(text)
    except ValueError:
        limit = -1.0
    if not 0 <= limit < float("inf"):
        raise FaceDiffError(f"{variable}={text}: not a valid size; expected gigabytes, 0 to keep nothing")
    return limit * 1e9
