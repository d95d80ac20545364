"""What all changes to a take have in common: random numbers of their own, smooth steps, a note in the metadata."""

from __future__ import annotations

import secrets
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from facediff.takes import Take

Array = npt.NDArray[np.float64]

PROCEDURAL = "procedural"
"""Metadata key: what was added by a program, not learnt from anybody."""
DIRECTED = "directed"
"""Metadata key: how the take's own motion was changed."""
SWAYS = "head sway"
"""How a swaying head is called in the metadata; such a take moves as a whole, so nothing can be laid on it any more."""

CHUNK = 256
"""Frames that are worked on at a time where not one by one."""

Layer = Literal["blinks", "gaze", "sway"]
STREAMS: dict[Layer, int] = {"blinks": 1, "gaze": 2, "sway": 3}


def random_of(layer: Layer, seed: int) -> np.random.Generator:
    """Random numbers of a layer: adding or leaving away another layer does not change them."""
    return np.random.default_rng([seed, STREAMS[layer]])


def smooth_step(values: npt.ArrayLike) -> Array:
    """3t² − 2t³ of values limited to 0 … 1: from 0 to 1 with flat ends."""
    t = np.clip(np.asarray(values, np.float64), 0.0, 1.0)
    return np.asarray(t * t * (3.0 - 2.0 * t))


def room_for(vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """An array of the same shape to write to: in memory, or on disk where the vertices are a memory map themselves.

    A file on disk lies beside the map's, or where temporary files go if that folder cannot be written, and vanishes
    with the array.
    """
    if not isinstance(vertices, np.memmap):
        return np.empty(vertices.shape, np.float32)
    beside = Path(vertices.filename).parent if vertices.filename is not None else Path(tempfile.gettempdir())
    name = f".facediff-{secrets.token_hex(8)}.partial"
    try:
        path = beside / name
        made = np.memmap(path, np.float32, "w+", shape=vertices.shape)
    except OSError:
        path = Path(tempfile.gettempdir()) / name
        made = np.memmap(path, np.float32, "w+", shape=vertices.shape)
    with suppress(OSError):  # Windows keeps a file that is in use
        path.unlink()
    return made


def parts(frames: int) -> Iterator[slice]:
    """Consecutive frames, some at a time."""
    return (slice(first, first + CHUNK) for first in range(0, frames, CHUNK))


def copied(vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """A copy to work on, see :func:`room_for`."""
    made = room_for(vertices)
    for part in parts(len(vertices)):
        made[part] = vertices[part]
    return made


def noted(take: Take, vertices: npt.NDArray[np.float32], key: str, words: str) -> Take:
    """The take with other vertices (T, V, 3), and words added to an entry of its metadata."""
    before = take.metadata.get(key)
    told = words if before is None else f"{before}; {words}"
    return replace(take, vertices=vertices, metadata={**take.metadata, key: told})
