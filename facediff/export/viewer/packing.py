"""A page's arrays as text: quantised, as differences between frames, deflated, in base64."""

from __future__ import annotations

import base64
import hashlib
import math
import weakref
import zlib
from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from tempfile import TemporaryFile
from typing import IO

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.animation.animation import measured
from facediff.errors import OptionError

STEP = 0.05
"""Quantisation of positions in mm. Rounding moves a coordinate by at most half of it, a vertex by √3 / 2 of it."""
CHUNK_FRAMES = 32  # Frames that are unpacked together; a jump in time costs one such chunk
PIECE = 1 << 20  # Bytes of a blob that are read at a time
LARGEST_STEP = np.iinfo(np.int16).max


class Blobs:
    """The binary parts of a page, deflated (zlib's format) and in base64; equal parts are kept once.

    They lie in a temporary file, since those of a long motion are too large for memory.

    Attributes:
        size: bytes of all texts.
    """

    def __init__(self) -> None:
        self._file = TemporaryFile()  # noqa: SIM115 - as long as this object
        weakref.finalize(self, _close, self._file)
        self._sizes: list[int] = []
        self._numbers: dict[bytes, int] = {}
        self.size = 0

    def add(self, data: bytes) -> int:
        """Keep bytes and return their number."""
        return self.add_pieces([data])

    def add_pieces(self, pieces: Iterable[bytes]) -> int:
        """Keep bytes that come piece by piece."""
        digest, deflate = hashlib.sha256(), zlib.compressobj(6)
        size, waiting = 0, b""
        for piece in pieces:
            digest.update(piece)
            waiting += deflate.compress(piece)
            whole = len(waiting) // 3 * 3  # bytes of four letters each
            size += self._file.write(base64.b64encode(waiting[:whole]))
            waiting = waiting[whole:]
        size += self._file.write(base64.b64encode(waiting + deflate.flush()))
        number = self._numbers.setdefault(digest.digest(), len(self._sizes))
        if number == len(self._sizes):
            self._sizes.append(size)
            self.size += size
        self._file.seek(self.size)
        return number

    def elements(self) -> Iterator[str]:
        """The elements of a page that hold them, in pieces and in the order of their numbers."""
        self._file.seek(0)
        for number, size in enumerate(self._sizes):
            yield f'<script type="text/plain" id="blob-{number}">'
            for start in range(0, size, PIECE):
                yield self._file.read(min(PIECE, size - start)).decode("ascii")
            yield "</script>\n"


def _close(file: IO[bytes]) -> None:
    with suppress(OSError):  # what a full disk could not hold has been said when it was written
        file.close()


def millimetres(animation: Animation) -> float:
    """Millimetres in one unit of an animation's length."""
    return 1000 * metres_per_unit(animation.unit)


def pack_mesh(
    points: npt.NDArray[np.floating],
    triangles: npt.NDArray[np.integer],
    colours: npt.NDArray[np.integer] | None,
    blobs: Blobs,
) -> dict[str, int | None]:
    """Keep a mesh at rest and return the numbers of its blobs.

    Points (V, 3) are in mm, triangles (F, 3) outward, since pages show the back of one as the hollow of the mouth,
    colours (V, 3) red, green and blue from 0 to 255.
    """
    return {
        "template": blobs.add(points.astype("<f4").tobytes()),
        "faces": blobs.add(triangles.astype("<u4").tobytes()),
        "colours": None if colours is None else blobs.add(colours.astype(np.uint8).tobytes()),
    }


def pack_motion(animation: Animation, blobs: Blobs) -> list[int]:
    """Keep a motion and return the numbers of its blobs, one for every `CHUNK_FRAMES` frames.

    With q[t] the offset from the template in steps of `STEP` mm, rounded, a chunk of k frames holds d[0] = q[0] and
    d[t] = q[t] − q[t−1], modulo 2¹⁶, as z = 2 d for d ≥ 0 and −2 d − 1 below, in the order axis, vertex, frame; first
    the low bytes of all, then the high bytes.
    """
    # The differences of one vertex are alike, and nearly all high bytes are 0, which deflate compresses well.
    scale = millimetres(animation) / STEP
    template = np.asarray(animation.template, np.float64)
    numbers = []
    for start in range(0, len(animation.vertices), CHUNK_FRAMES):
        steps = np.rint((np.asarray(animation.vertices[start : start + CHUNK_FRAMES], np.float64) - template) * scale)
        furthest = float(np.abs(steps).max(initial=0))
        if furthest > LARGEST_STEP:
            raise OptionError.naming(
                f"{animation.name}: moves {furthest * STEP / 1000:.3g} m away from its template; give the unit of "
                f"length ({{unit}}) and the template ({{mesh}}) that belong to it"
            )
        steps_of_chunk: npt.NDArray[np.int32] = steps.astype(np.int32)
        differences = np.diff(steps_of_chunk, axis=0, prepend=np.zeros_like(steps_of_chunk[:1]))
        # Modulo 2¹⁶: the sums of 16 bits that the page computes come out right, however far two frames are apart.
        differences = differences.astype(np.int16).astype(np.int32)
        folded = ((differences << 1) ^ (differences >> 31)).astype(np.uint16).transpose(2, 1, 0)
        numbers.append(blobs.add((folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()))
    return numbers


def mouth_opening(animation: Animation) -> npt.NDArray[np.float32] | None:
    """The mouth's opening in each frame in mm, (T,): the mean distance of the inner lips' pairs; None if unknown."""
    pairs = animation.inner_lip_pairs
    if pairs is None or not len(pairs):
        return None

    def opening(vertices: npt.NDArray[np.float32]) -> npt.NDArray[np.floating]:
        lips = np.asarray(vertices[:, pairs], np.float64)
        return np.asarray(np.linalg.norm(lips[:, :, 0] - lips[:, :, 1], axis=2).mean(axis=1))

    return np.asarray(measured(animation.vertices, opening) * millimetres(animation), np.float32)


def bounds(points: npt.NDArray[np.floating], triangles: npt.NDArray[np.integer]) -> tuple[list[float], list[float]]:
    """Centre and half extents (x, y, z) of the surface of points (V, 3) with triangles (F, 3)."""
    surface = points[np.unique(triangles)]
    low, high = surface.min(axis=0), surface.max(axis=0)
    return ((low + high) / 2).round(3).tolist(), ((high - low) / 2).round(3).tolist()


def heat_scale_end(truth: Animation, predictions: Sequence[Animation]) -> float:
    """Error in mm that gets a heat map's last colour: the worst 99th percentile, rounded up to one digit."""
    # 200 frames are enough for a percentile, and few enough for memory.
    sample = np.unique(np.linspace(0, len(truth.vertices) - 1, 200).astype(int))
    right = np.asarray(truth.vertices[sample], np.float64) * millimetres(truth)
    largest = 0.1
    for animation in predictions:
        positions = np.asarray(animation.vertices[sample], np.float64) * millimetres(animation)
        largest = max(largest, float(np.quantile(np.linalg.norm(positions - right, axis=2), 0.99)))
    return round_up(largest)


def round_up(value: float) -> float:
    """The next number of one digit.

    >>> [round_up(value) for value in (0.1, 0.34, 1.0, 2.1, 7.0, 91.0)]
    [0.1, 0.4, 1.0, 3.0, 7.0, 100.0]
    """
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return round(math.ceil(value / power - 1e-9) * power, 9)
