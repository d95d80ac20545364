"""Arrays kept on disk between runs: decoded speech, features of frozen encoders."""

from __future__ import annotations

import hashlib
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.files import atomic


class ArrayStore:
    """A folder of arrays by key. Anything in it may be removed at any time: it is made anew.

    Args:
        folder: where the arrays lie; made when the first one is put in.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._writable = True

    @staticmethod
    def key(*parts: object) -> str:
        """A key from anything that decides the array; equal parts give equal keys on every machine."""
        return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()[:40]

    def path(self, key: str) -> Path:
        """Where an array lies, or would lie."""
        return self.folder / key[:2] / f"{key}.npy"

    def get(self, key: str) -> npt.NDArray[Any] | None:
        """The array, memory-mapped; None if there is none. A damaged file counts as none and is said once."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            return np.load(path, mmap_mode="r", allow_pickle=False)
        except Exception:  # a damaged header makes NumPy raise anything
            warnings.warn(f"{path}: a damaged or half-written cache file; it is made anew", stacklevel=2)
            return None

    def put(self, key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Keep an array and hand it back; where the folder cannot be written this is said once and nothing is kept."""
        if not self._writable:
            return array
        try:
            with atomic(self.path(key)) as temporary:
                np.save(temporary, array)
        except FaceDiffError as error:
            self._writable = False
            warnings.warn(f"{error}; going on without the cache, slower", stacklevel=2)
            return array
        return array
