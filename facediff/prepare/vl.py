"""The ``.vl`` files of BIWI: one frame each, a count of vertices and then float32 x, y, z for each."""

from __future__ import annotations

import os
import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

FRAME_NAME = re.compile(r"frame_(\d+)\.vl", re.IGNORECASE)
HEADERS = (4, 8)
"""Bytes of the count: the authors wrote an "unsigned long", whose width is the platform's."""


def read_vl(path: Path) -> npt.NDArray[np.float32]:
    """Vertices (V, 3) of one frame, in mm.

    The width of the count is told by the file's size.

    Raises:
        FaceDiffError: if the file is missing, or its size does not fit its count: bytes found and expected are named.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected a frame of BIWI") from error
    for header in HEADERS:
        count, rest = divmod(len(data) - header, 12)
        if count > 0 and rest == 0 and int.from_bytes(data[:header], "little") == count:
            return np.frombuffer(data, "<f4", offset=header).reshape(count, 3)
    told = int.from_bytes(data[:4], "little")
    raise FaceDiffError(
        f"{path}: has {len(data)} bytes, but its header tells {told} vertices, for which "
        f"{told * 12 + 4} or {told * 12 + 8} bytes are expected; it is truncated or damaged, copy it anew"
    )


def frame_files(folder: Path) -> dict[int, Path]:
    """The frames of a sequence by number, in numeric order.

    Raises:
        FaceDiffError: if the folder cannot be read, or two files claim the same number.
    """
    found: dict[int, Path] = {}
    try:
        names = os.listdir(folder)
    except OSError as error:
        raise FaceDiffError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from error
    for name in names:
        match = FRAME_NAME.fullmatch(name)
        if match is None:
            continue
        number, path = int(match[1]), folder / name
        if number in found:
            raise FaceDiffError(f"{path}: has the same frame number as {found[number].name}; remove one of them")
        found[number] = path
    return dict(sorted(found.items()))


def gaps(numbers: list[int]) -> list[str]:
    """What is not there in a numbering that should begin with 1 (or 0), e.g. ``["5", "9 to 12"]``."""
    missing = []
    for before, after in zip([0, *numbers], numbers, strict=False):
        if after - before > 1:
            first, last = before + 1, after - 1
            missing.append(f"{first}" if first == last else f"{first} to {last}")
    return missing


def check_sizes(files: list[Path]) -> None:
    """All frames of a sequence must be of one size, or a truncated file could pass for one with a shorter header.

    Raises:
        FaceDiffError: naming the first file that is not as large as most are.
    """
    sizes = [path.stat().st_size for path in files]
    usual = max(set(sizes), key=lambda size: (sizes.count(size), size))
    for path, size in zip(files, sizes, strict=True):
        if size != usual:
            raise FaceDiffError(
                f"{path}: has {size} bytes, expected {usual} as in the sequence's other frames; it is truncated or "
                f"from another mesh, copy it anew"
            )
