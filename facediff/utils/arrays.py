"""NumPy's files: reading them safely, as motion or as they are, and keeping arrays on disk between runs."""

from __future__ import annotations

import hashlib
import warnings
from collections.abc import Container
from pathlib import Path
from threading import Lock
from typing import IO, Any, Literal, Self

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, damaged
from facediff.utils.files import atomic

# NumPy parses a file's header with Python's own parser, which two threads that read at the same time can break in
# Python 3.11 (SystemError, "AST constructor recursion depth mismatch").
_PARSING = Lock()


def open_array(path: Path, *, kinds: str = "", mode: Literal["r", "c"] = "r", name: str = "") -> npt.NDArray[Any]:
    """The array of a ``.npy`` file, memory-mapped.

    Args:
        path: the file.
        kinds: NumPy's letters for the kinds of numbers that are accepted, of which there must be at least one; any if
            empty.
        mode: ``r``, or ``c`` for an array that may be written to without changing the file.
        name: the file in messages, such as the option that names it.
    """
    name = name or str(path)
    # A damaged header makes NumPy raise anything.
    with damaged(f"{name}: not a readable NumPy array", "expected a .npy file of numbers", Exception):
        with _PARSING, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # NumPy's advice on headers that Python 2 wrote
            array = np.load(path, mmap_mode=mode, allow_pickle=False)
        if not isinstance(array, np.ndarray):
            array.close()
            raise ValueError("is an archive of several arrays, name it .npz")
    if kinds and (not array.size or array.dtype.kind not in kinds):
        expected = "floating-point numbers" if kinds == "f" else "numbers"
        raise FaceDiffError(f"{name}: holds {array.dtype} {array.shape}; expected {expected}")
    return array


def open_vertices(
    path: Path, n_vertices: int | None = None, *, mode: Literal["r", "c"] = "r"
) -> npt.NDArray[np.floating]:
    """Absolute vertices (T, V, 3) of a file that holds (T, 3V) or (T, V, 3), memory-mapped.

    Any number of vertices will do if ``n_vertices`` is None; ``mode`` is as for :func:`open_array`.
    """
    array = open_array(path, kinds="f", mode=mode)
    count = vertices_of(array.shape)
    if count is None or n_vertices not in (None, count):
        expected = "(frames, 3 * vertices)" if n_vertices is None else f"(frames, {3 * n_vertices})"
        raise FaceDiffError(f"{path}: has shape {array.shape}, expected {expected} or (frames, vertices, 3)")
    return array.reshape(len(array), count, 3)


def vertices_of(shape: tuple[int, ...]) -> int | None:
    """Vertices of an array of motion, by its shape (T, 3V) or (T, V, 3); None for any other shape."""
    if len(shape) == 3 and shape[2] == 3:
        return shape[1] or None
    return shape[1] // 3 or None if len(shape) == 2 and shape[1] % 3 == 0 else None


def read_arrays(
    path: Path, keys: Container[str] | None = None, *, remedy: str = "write it again"
) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a ``.npz`` file by name: of ``keys``, or all; messages end in ``remedy``."""
    # zipfile, zlib and NumPy each have several exceptions for damaged files.
    with damaged(f"{path}: not a readable .npz file", remedy, Exception), _PARSING, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's advice on headers that Python 2 wrote
        # Opened here, since NumPy leaves a damaged archive open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
            return {entry: archive[entry] for entry in archive.files if keys is None or entry in keys}


class ArrayWriter:
    """A .npy file of float32 that grows by rows of a shape; its header is valid at the end of a ``with``."""

    def __init__(self, path: Path, row: tuple[int, ...]) -> None:
        self.row = row
        self.rows = 0  # written so far
        self._stream = path.open("wb")
        write_header(self._stream, (0, *row))

    def write(self, rows: npt.NDArray[np.floating]) -> None:
        """Add rows (n, *row)."""
        self._stream.write(np.ascontiguousarray(rows, "<f4").tobytes())
        self.rows += len(rows)

    def close(self) -> None:
        """Write the number of rows into the header."""
        with self._stream:
            self._stream.seek(0)
            write_header(self._stream, (self.rows, *self.row))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


def write_header(stream: IO[bytes], shape: tuple[int, ...]) -> None:
    """The beginning of a .npy file of float32, which may be overwritten: NumPy leaves room for more rows."""
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})


class ArrayStore:
    """A folder of arrays by key, kept between runs; anything in it may be removed at any time."""

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
        """The array, memory-mapped; None if there is none, or with a warning if its file is damaged."""
        path = self.path(key)
        if not path.is_file():
            return None
        try:
            return open_array(path)
        except FaceDiffError:
            warnings.warn(f"{path}: a damaged or half-written cache file; it is made again", stacklevel=2)
            return None

    def put(self, key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Keep an array and return it; a folder that cannot be written to is reported once and not tried again."""
        if not self._writable:
            return array
        try:
            with atomic(self.path(key)) as temporary:
                np.save(temporary, array)
        except FaceDiffError as error:
            self._writable = False
            warnings.warn(f"{error}; going on without the cache, slower", stacklevel=2)
        return array
