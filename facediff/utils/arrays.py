"""NumPy's files: reading them safely, as motion or as they are, and keeping arrays on disk between runs."""

from __future__ import annotations

import hashlib
import io
import math
import os
import warnings
import zipfile
from collections.abc import Container
from pathlib import Path
from threading import Lock
from typing import IO, Any, Literal

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.files import atomic
from facediff.utils.limits import LIMITS, brief, check_array, quoted

# NumPy parses a file's header with Python's own parser, which two threads that read at the same time can break in
# Python 3.11 (SystemError, "AST constructor recursion depth mismatch").
_PARSING = Lock()

HEADER_BYTES = 10_000
"""Longest header of an array; NumPy itself evaluates no longer one, but would first read gigabytes of it."""

PLAIN_KINDS = "biufcSU"
"""NumPy's letters for what arrays may hold: truth values, whole, floating and complex numbers, and text."""


def open_array(path: Path, *, kinds: str = "", mode: Literal["r", "c"] = "r", name: str = "") -> npt.NDArray[Any]:
    """The array of a ``.npy`` file, memory-mapped.

    Args:
        path: the file.
        kinds: NumPy's letters for the kinds of numbers that are accepted, of which there must be at least one: ``f``
            for floating point, ``fiu`` for whole numbers as well; anything if empty.
        mode: ``r``, or ``c`` for an array that may be written to without changing the file.
        name: what messages call the file, e.g. the option that names it; its path if empty.
    """
    name = name or str(path)
    if not path.is_file():
        raise FaceDiffError(f"{name}: no such file, or no regular file; expected a NumPy array (.npy)")
    try:
        with path.open("rb") as stream:  # once: on network storage, opening a file takes milliseconds
            size = os.fstat(stream.fileno()).st_size
            if stream.read(4) == b"PK\x03\x04":
                raise FaceDiffError(f"{name}: is an archive of several arrays; name it .npz")
            stream.seek(0)
            shape, fortran, dtype = read_header(stream)
            offset = stream.tell()
            # What is mapped takes no memory, so only the file's own size bounds it; empty axes must not be endless.
            check_array(name, shape, 0)
            needed = offset + math.prod(shape) * dtype.itemsize
            if size < needed:
                raise FaceDiffError(
                    f"{name}: is cut short: its {size} bytes are fewer than its header says; copy it again"
                )
            if size > needed:
                raise FaceDiffError(f"{name}: holds {size - needed} bytes more than its header says; write it again")
            order: Literal["F", "C"] = "F" if fortran else "C"
            array: npt.NDArray[Any] = np.memmap(stream, dtype, mode, offset, shape, order)
    except FaceDiffError:
        raise
    except Exception as error:  # a damaged header makes NumPy raise anything
        raise FaceDiffError(
            f"{name}: not a readable NumPy array ({brief(error)}); expected a .npy file of numbers"
        ) from error
    if kinds and not array.size:
        raise FaceDiffError(f"{name}: holds no numbers, its shape is {array.shape}; write it again")
    if kinds and array.dtype.kind not in kinds:
        expected = "floating-point numbers" if kinds == "f" else "numbers"
        raise FaceDiffError(f"{name}: holds {array.dtype} {array.shape}; expected {expected}")
    return array


def open_vertices(
    path: Path, n_vertices: int | None = None, *, mode: Literal["r", "c"] = "r"
) -> npt.NDArray[np.floating]:
    """Absolute vertices (T, V, 3) of a file that holds (T, 3V) or (T, V, 3), memory-mapped.

    Any number of vertices will do if ``n_vertices`` is None; ``mode`` is that of :func:`open_array`.
    """
    array = open_array(path, kinds="f", mode=mode)
    count = vertices_of(array.shape)
    if count is None or n_vertices not in (None, count):
        expected = "(frames, 3 * vertices)" if n_vertices is None else f"(frames, {3 * n_vertices})"
        raise FaceDiffError(f"{path}: has shape {array.shape}, expected {expected} or (frames, vertices, 3)")
    LIMITS.check("frames", len(array), path)
    LIMITS.check("vertices", count, path)
    if not array.flags.c_contiguous:
        LIMITS.check("bytes", array.nbytes, path)  # columns first: taken apart, the array is copied into memory
    return array.reshape(len(array), count, 3)


def vertices_of(shape: tuple[int, ...]) -> int | None:
    """Vertices of an array of motion, by its shape (T, 3V) or (T, V, 3); None for any other shape."""
    if len(shape) == 3 and shape[2] == 3:
        return shape[1] or None
    return shape[1] // 3 or None if len(shape) == 2 and shape[1] % 3 == 0 else None


def read_arrays(
    path: Path, keys: Container[str] | None = None, *, name: str = "", remedy: str = "write it again"
) -> dict[str, npt.NDArray[Any]]:
    """The arrays of a ``.npz`` file, by name.

    Args:
        path: the file.
        keys: the arrays to read; all if None.
        name: what messages call the file; its path if empty.
        remedy: what messages advise.
    """
    name = name or str(path)
    try:
        with path.open("rb") as stream, zipfile.ZipFile(stream) as archive:
            return _checked_members(archive, keys, name)
    except FaceDiffError as error:
        raise FaceDiffError(f"{error}; {remedy}") from error
    except Exception as error:  # zipfile, zlib and NumPy each have several exceptions for damaged files
        raise FaceDiffError(f"{name}: not a readable .npz file ({brief(error)}); {remedy}") from error


def _checked_members(archive: zipfile.ZipFile, keys: Container[str] | None, name: str) -> dict[str, npt.NDArray[Any]]:
    """The arrays of an open archive; all headers are checked before the first array is read."""
    members: dict[str, zipfile.ZipInfo] = {}
    LIMITS.check("entries", len(archive.infolist()), name)
    for member in archive.infolist():
        entry = member.filename.removesuffix(".npy")
        if keys is not None and entry not in keys:
            continue
        if entry in members:
            raise FaceDiffError(f"{name}: holds two entries {quoted(entry)}")
        if not entry.isprintable() or "/" in entry or "\\" in entry or not member.filename.endswith(".npy"):
            raise FaceDiffError(f"{name}: holds an entry {quoted(member.filename)}; expected arrays only")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise FaceDiffError(f"{name}: its entry {quoted(entry)} is not compressed as NumPy compresses")
        members[entry] = member
    LIMITS.check("bytes", sum(member.file_size for member in members.values()), name)
    for entry, member in members.items():
        with archive.open(member) as opened:
            shape, _, dtype = read_header(opened)
            check_array(f"{name}: {entry}", shape, dtype.itemsize)
            if opened.tell() + math.prod(shape) * dtype.itemsize != member.file_size:
                raise FaceDiffError(f"{name}: its entry {entry} is shorter or longer than its header says")
    held = {}
    for entry, member in members.items():
        with archive.open(member) as opened, _PARSING, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            held[entry] = np.lib.format.read_array(opened, allow_pickle=False)
            opened.read(1)  # at its end the archive compares the checksum
    return held


def read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype[Any]]:
    """Shape, Fortran order and type that an ``.npy`` stream declares; the stream stands at the numbers then.

    Raises:
        ValueError: if there is no valid header of an array of plain values.
    """
    version = np.lib.format.read_magic(stream)
    width = {(1, 0): 2, (2, 0): 4}.get(version)
    if width is None:
        raise ValueError(f"format version {version} is only for structured types")
    prefix = stream.read(width)
    length = int.from_bytes(prefix, "little")
    if length > HEADER_BYTES:
        raise ValueError(f"a header of {length} bytes; expected at most {HEADER_BYTES}")
    text = io.BytesIO(prefix + stream.read(length))
    read = np.lib.format.read_array_header_1_0 if width == 2 else np.lib.format.read_array_header_2_0
    with _PARSING, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # NumPy's advice on headers that Python 2 wrote
        shape, fortran, dtype = read(text)
    if dtype.kind not in PLAIN_KINDS:
        raise ValueError(f"it holds {quoted(dtype)}; expected plain numbers or text")
    if any(size < 0 for size in shape):
        raise ValueError(f"its shape is {quoted(shape)}")
    return shape, fortran, dtype


class ArrayStore:
    """A folder of arrays by key, kept between runs. Anything in it may be removed at any time: it is made again.

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
