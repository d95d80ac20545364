"""A page's arrays as text: quantised, as differences between frames, deflated, in base64."""

from __future__ import annotations

import base64
import hashlib
import math
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.errors import OptionError

STEP = 0.05
"""Quantisation of positions in mm. Rounding moves a coordinate by at most half of it, a vertex by √3 / 2 of it."""
CHUNK_FRAMES = 32  # Frames that are unpacked together; a jump in time costs one such chunk
LARGEST_STEP = np.iinfo(np.int16).max


class Blobs:
    """The binary parts of a page; equal parts are kept once."""

    def __init__(self) -> None:
        self.texts: list[str] = []  # the parts, deflated (zlib's format) and in base64
        self._numbers: dict[bytes, int] = {}

    def add(self, data: bytes) -> int:
        """Keep bytes and return their number."""
        digest = hashlib.sha256(data).digest()
        if digest not in self._numbers:
            self._numbers[digest] = len(self.texts)
            self.texts.append(base64.b64encode(zlib.compress(data, 6)).decode("ascii"))
        return self._numbers[digest]


def millimetres(animation: Animation) -> float:
    """Millimetres in one unit of an animation's length."""
    return 1000 * metres_per_unit(animation.unit)


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
    lips = np.asarray(animation.vertices[:, pairs], np.float64)
    distances = np.linalg.norm(lips[:, :, 0] - lips[:, :, 1], axis=2)
    return np.asarray(distances.mean(axis=1) * millimetres(animation), np.float32)


def bounds(animation: Animation) -> tuple[list[float], list[float]]:
    """Centre and half extents (x, y, z) of the template's surface, in mm."""
    surface = np.asarray(animation.template, np.float64)[np.unique(animation.triangles)] * millimetres(animation)
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
