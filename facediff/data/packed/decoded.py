"""A cache in memory for decoded chunks of motion, bounded in bytes."""

from __future__ import annotations

import os
from collections import OrderedDict
from threading import Lock
from typing import Any

import numpy.typing as npt

from facediff.utils.ranges import Range

VARIABLE, USUAL_GB = "FACEDIFF_PACKED_MEMORY_GB", 0.5
"""Size of the cache in gigabytes, of all loader processes together: the variable that sets it, and its default."""

Key = tuple[str, int]
"""Array and chunk."""


class DecodedChunks:
    """The chunks used last, as far as they are used again.

    A chunk is stored when it is read a second time, with no more others in between than fit. Storing would be wasted
    on a corpus larger than the cache: its chunks would be replaced before they are used again.

    Args:
        limit: bytes; those that the environment names if None.
    """

    def __init__(self, limit: float | None = None) -> None:
        usual = 1e9 * Range(0, 1e9).read(VARIABLE, os.environ.get(VARIABLE, str(USUAL_GB)))
        self.limit = usual if limit is None else limit
        self._reset()

    def _reset(self) -> None:
        self._chunks: OrderedDict[Key, npt.NDArray[Any]] = OrderedDict()
        self._recent: OrderedDict[Key, None] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def __getstate__(self) -> dict[str, Any]:
        """Leave out the chunks and the lock."""
        return {"limit": self.limit}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Start empty."""
        self.__init__(**state)  # type: ignore[misc]

    @property
    def bytes(self) -> int:
        """Bytes of all chunks that are stored."""
        return self._bytes

    def get(self, key: Key) -> npt.NDArray[Any] | None:
        """A decoded chunk, which must not be changed; None if it is not stored."""
        with self._lock:
            chunk = self._chunks.get(key)
            if chunk is not None:
                self._chunks.move_to_end(key)
            return chunk

    def stores(self, key: Key, size: int, share: int = 1) -> bool:
        """Whether a chunk of ``size`` bytes that was read just now was read shortly before, and so is to be stored.

        Args:
            key: array and number.
            size: of the chunk in bytes.
            share: processes that the limit is divided by.
        """
        with self._lock:
            if key in self._recent:
                del self._recent[key]
                return True
            self._recent[key] = None
            while len(self._recent) > self.limit / share // size:
                self._recent.popitem(last=False)
            return False

    def put(self, key: Key, chunk: npt.NDArray[Any], share: int = 1) -> None:
        """Store a copy of a chunk."""
        with self._lock:
            if key not in self._chunks:
                self._chunks[key] = chunk.copy()
                self._bytes += chunk.nbytes
            while self._bytes > self.limit / share:
                self._bytes -= self._chunks.popitem(last=False)[1].nbytes
