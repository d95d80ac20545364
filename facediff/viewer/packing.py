"""Arrays as text for a page: quantised, taken apart into differences in time, deflated, in base64."""

from __future__ import annotations

import base64
import hashlib
import zlib

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.takes import Take, metres_per_unit

STEP = 0.05
"""Quantisation of positions, in mm. Rounding moves a coordinate by at most half of it, a vertex by √3 / 2 of it:
0.0433 mm."""
CHUNK_FRAMES = 32
"""Frames that are decoded together; a jump in time costs one such chunk."""
_LARGEST = np.iinfo(np.int16).max
_LEVEL = 6


class Blobs:
    """The binary parts of a page; equal ones are kept once."""

    def __init__(self) -> None:
        self._places: dict[bytes, int] = {}
        self.texts: list[str] = []

    def add(self, data: bytes) -> int:
        """Deflate (zlib's format) and keep bytes; gives their number."""
        digest = hashlib.sha256(data).digest()
        if digest not in self._places:
            self._places[digest] = len(self.texts)
            self.texts.append(base64.b64encode(zlib.compress(data, _LEVEL)).decode("ascii"))
        return self._places[digest]

    @property
    def size(self) -> int:
        """Characters in all."""
        return sum(map(len, self.texts))


def millimetres(take: Take) -> float:
    """Millimetres in one unit of a take's length."""
    return 1000 * metres_per_unit(take.unit)


def pack_motion(take: Take, blobs: Blobs) -> list[int]:
    """Numbers of the blobs that hold a motion, one for every `CHUNK_FRAMES` frames.

    With q[t] the offset from the template in steps of `STEP` mm, rounded, a chunk of k frames holds
    d[0] = q[0] and d[t] = q[t] − q[t−1], modulo 2¹⁶, as z = 2 d for d ≥ 0 and −2 d − 1 below, in the order axis,
    vertex, frame; first the low bytes of all, then the high bytes. Values of one vertex are alike, and next to none
    has a high byte, so that deflate finds little to write.

    Raises:
        FaceDiffError: if a vertex is further from the template than 16 bits can say (1.6 m).
    """
    scale = millimetres(take) / STEP
    template = np.asarray(take.template, np.float64)
    numbers = []
    for start in range(0, len(take.vertices), CHUNK_FRAMES):
        steps = np.rint((np.asarray(take.vertices[start : start + CHUNK_FRAMES], np.float64) - template) * scale)
        furthest = float(np.abs(steps).max(initial=0))
        if furthest > _LARGEST:
            raise FaceDiffError(
                f"{take.name}: moves {furthest * STEP / 1000:.3g} m away from its template; give the unit of length "
                f"(--unit) and the template (--mesh) that belong to it"
            )
        numbers.append(blobs.add(_pack_chunk(steps.astype(np.int32))))
    return numbers


def _pack_chunk(steps: npt.NDArray[np.int32]) -> bytes:
    differences = np.diff(steps, axis=0, prepend=np.zeros_like(steps[:1]))
    # Modulo 2¹⁶: sums of 16 bits come out right, however far two frames are apart.
    differences = differences.astype(np.int16).astype(np.int32)
    folded = ((differences << 1) ^ (differences >> 31)).astype(np.uint16).transpose(2, 1, 0)
    return (folded & 255).astype(np.uint8).tobytes() + (folded >> 8).astype(np.uint8).tobytes()


def opening(take: Take) -> npt.NDArray[np.float32] | None:
    """The mouth's opening in each frame in mm, (T,): the mean distance of the inner lips' pairs; None if unknown."""
    pairs = take.inner_lip_pairs
    if pairs is None or not len(pairs):
        return None
    lips = np.asarray(take.vertices[:, pairs], np.float64)
    distances = np.linalg.norm(lips[:, :, 0] - lips[:, :, 1], axis=2)
    return np.asarray(distances.mean(axis=1) * millimetres(take), np.float32)


def bounds(take: Take) -> tuple[list[float], list[float]]:
    """Centre and half extents (x, y, z) of the template's surface, in mm."""
    shown = np.asarray(take.template, np.float64)[np.unique(take.triangles)] * millimetres(take)
    low, high = shown.min(axis=0), shown.max(axis=0)
    return ((low + high) / 2).round(3).tolist(), ((high - low) / 2).round(3).tolist()
