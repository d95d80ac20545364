"""Reading single chunks of a sharded array, with memory bounded beforehand.

The zarr package could read them as well. But it runs any codec that the metadata name, trusts the size in a chunk's
header, and spends some milliseconds in its event loop for each window, in threads that do not survive the forks of a
data loader.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from functools import cached_property
from threading import local
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.data.packed.layout import DAMAGED, METADATA, ArrayInfo, check_array_metadata
from facediff.data.packed.stores import ByteRange, ByteStore
from facediff.errors import FaceDiffError, needs_extra
from facediff.utils.limits import brief

MISSING = 2**64 - 1
"""Offset and size of a chunk that a shard does not hold."""
CHECKSUM = 4
HEADER = struct.Struct("<BBBBIII")
"""Of a Blosc buffer: two versions, flags, size of a number, bytes decoded, bytes of a block, bytes encoded."""


class ShardedArray:
    """Read access to an array of a packed corpus.

    Args:
        store: where it lies.
        name: the array's name.
        info: its entry in the record.
    """

    def __init__(self, store: ByteStore, name: str, info: ArrayInfo) -> None:
        self.store = store
        self.name = name
        self.info = info
        self._indices: dict[int, npt.NDArray[np.uint64]] = {}
        self._checked = False
        self._reset()

    def _reset(self) -> None:
        self._scratch = local()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out memory of threads, which cannot be pickled."""
        return {name: value for name, value in self.__dict__.items() if name not in ("_scratch", "_codecs")}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start without."""
        self.__dict__.update(state)
        self._reset()

    @cached_property
    def _codecs(self) -> tuple[Any, Any]:
        """Blosc and CRC-32C."""
        with needs_extra("zarr", "packed", "reading a packed corpus"):
            import google_crc32c
            from numcodecs import blosc
        # Its own threads would not survive a fork, and chunks are decoded in several threads already.
        blosc.use_threads = False
        return blosc, google_crc32c

    def chunks_of_rows(self, first: int, stop: int) -> range:
        """The chunks that hold rows ``first`` to ``stop``."""
        return range(first // self.info.chunk, -(-stop // self.info.chunk)) if stop > first else range(0)

    def fetch(self, first: int, stop: int) -> list[memoryview]:
        """The encoded bytes of chunks ``first`` to ``stop``, counted over the whole array."""
        if not self._checked:
            check_array_metadata(
                self.store.whole(f"{self.name}/{METADATA}"), f"{self.store.source}/{self.name}/{METADATA}", self.info
            )
            self._checked = True
        encoded: list[memoryview] = []
        per_shard = self.info.chunks
        for shard in range(first // per_shard, -(-stop // per_shard)):
            low, high = max(first - shard * per_shard, 0), min(stop - shard * per_shard, per_shard)
            index = self._index(shard)
            byte_ranges: list[ByteRange] = []
            for number in range(low, high):
                start, size = (int(value) for value in index[number])
                if MISSING in (start, size) or start + size > self.info.shards[shard]:
                    raise self._damaged(shard * per_shard + number, "is not there")
                byte_ranges.append((start, size))
            encoded += self.store.ranges(self._key(shard), byte_ranges)
        return encoded

    def decode(self, number: int, encoded: memoryview) -> npt.NDArray[Any]:
        """A chunk (rows, width), or (rows,), in memory that the thread's next call overwrites."""
        blosc, crc32c = self._codecs
        body = encoded[:-CHECKSUM]
        if len(encoded) < HEADER.size + CHECKSUM or crc32c.value(bytes(body)) != int.from_bytes(
            encoded[-CHECKSUM:], "little"
        ):
            raise self._damaged(number, "its checksum is wrong")
        _, _, _, _, decoded, _, size = HEADER.unpack_from(body)
        if decoded != self.info.chunk_bytes or size != len(body):
            raise self._damaged(number, f"expands to {decoded} bytes instead of {self.info.chunk_bytes}")
        scratch = getattr(self._scratch, "chunk", None)
        if scratch is None:
            shape = (self.info.chunk, self.info.width) if self.info.width else (self.info.chunk,)
            scratch = self._scratch.chunk = np.empty(shape, np.dtype(self.info.dtype).newbyteorder("<"))
        try:
            blosc.decompress(body, scratch)
        except Exception as error:  # RuntimeError, and others of the wrapper
            raise self._damaged(number, brief(error)) from error
        return scratch

    def read(self, first: int, stop: int) -> npt.NDArray[Any]:
        """Rows ``first`` to ``stop``."""
        width = (self.info.width,) if self.info.width else ()
        rows = np.empty((max(0, stop - first), *width), self.info.dtype)
        chunk = self.info.chunk
        numbers = self.chunks_of_rows(first, stop)
        for number, encoded in zip(numbers, self.fetch(numbers.start, numbers.stop), strict=True):
            low, high = max(first, number * chunk), min(stop, (number + 1) * chunk)
            rows[low - first : high - first] = self.decode(number, encoded)[
                low - number * chunk : high - number * chunk
            ]
        return rows

    def _index(self, shard: int) -> npt.NDArray[np.uint64]:
        """Offset and size of every chunk of a shard (chunks, 2), read once."""
        cached = self._indices.get(shard)
        if cached is not None:
            return cached
        size, length = self.info.shards[shard], 16 * self.info.chunks + CHECKSUM
        if size < length:
            raise FaceDiffError(f"{self.store.source}/{self._key(shard)}: is shorter than its index; {DAMAGED}")
        (content,) = self.store.ranges(self._key(shard), [(size - length, length)])
        body = bytes(content[:-CHECKSUM])
        if self._codecs[1].value(body) != int.from_bytes(content[-CHECKSUM:], "little"):
            raise FaceDiffError(
                f"{self.store.source}/{self._key(shard)}: the checksum of its index is wrong; {DAMAGED}"
            )
        index = np.frombuffer(body, "<u8").reshape(-1, 2)
        self._indices[shard] = index
        return index

    def _key(self, shard: int) -> str:
        return f"{self.name}/{shard_key(shard, self.info.width)}"

    def _place(self, number: int) -> str:
        shard, inner = divmod(number, self.info.chunks)
        return f"{self.store.source}/{self._key(shard)}: chunk {inner}"

    def _damaged(self, number: int, what: str) -> FaceDiffError:
        return FaceDiffError(f"{self._place(number)} {what}; {DAMAGED}")


def shard_key(shard: int, width: int) -> str:
    """Path of a shard below its array, by Zarr's default encoding of keys."""
    return f"c/{shard}/0" if width else f"c/{shard}"


def chunks_of(rows: Sequence[int], chunk: int) -> dict[int, list[tuple[int, int]]]:
    """For each chunk its requested rows, in order, with their number in the result.

    Example:
        >>> chunks_of(range(24, 27), 25)
        {0: [(24, 0)], 1: [(0, 1), (1, 2)]}
    """
    rows_by_chunk: dict[int, list[tuple[int, int]]] = {}
    for number, row in enumerate(rows):
        chunk_number, inner = divmod(row, chunk)
        rows_by_chunk.setdefault(chunk_number, []).append((inner, number))
    return rows_by_chunk
