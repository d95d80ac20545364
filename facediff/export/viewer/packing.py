"""Arrays as text for a page: quantised, taken apart into differences in time, deflated, in base64."""

from __future__ import annotations

import base64
import hashlib
import io
import math
import wave
import zlib
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.errors import FaceDiffError

# What cannot be shown is refused before anything is written.

MOST = 4
"""Takes on one page."""


def check_animations(takes: Sequence[Animation], truth: int | None) -> None:
    """Refuse takes that do not make a page.

    Raises:
        FaceDiffError: if there are too few or too many, their clocks differ, one has no mesh or is not finite, or
            ``truth`` numbers none of them.
    """
    if not 1 <= len(takes) <= MOST:
        raise FaceDiffError(f"a page shows 1 to {MOST} takes side by side, not {len(takes)}; choose among them")
    if truth is not None and not 0 <= truth < len(takes):
        raise FaceDiffError(f"truth is number {truth} of {len(takes)} takes; number them from 0")
    first = takes[0]
    for animation in takes:
        if animation.frame_rate != first.frame_rate:
            raise FaceDiffError(
                f"{animation.name}: has {animation.frame_rate:g} frames a second and {first.name} {first.frame_rate:g}; takes on "
                f"one page need the same frame rate"
            )
        if len(animation.vertices) != len(first.vertices):
            raise FaceDiffError(
                f"{animation.name}: has {len(animation.vertices)} frames and {first.name} {len(first.vertices)}; takes on one "
                f"page need the same length: cut them, as `facediff view --shortest` does"
            )
        check_animation(animation)


def check_animation(animation: Animation) -> None:
    """Refuse a take that cannot be drawn.

    Raises:
        FaceDiffError: naming what is wrong.
    """
    if not len(animation.triangles) or not np.isfinite(animation.template).all():
        raise FaceDiffError(f"{animation.name}: its template holds NaN or infinity; give a sound mesh")
    animation.refuse_not_finite()
    pairs, count = animation.inner_lip_pairs, len(animation.template)
    if pairs is not None and len(pairs) and (pairs.ndim != 2 or pairs.shape[1] != 2 or not _within(pairs, count)):
        raise FaceDiffError(
            f"{animation.name}: its pairs of inner lips have shape {pairs.shape} and go up to vertex {int(pairs.max())} of "
            f"{count}; expected (pairs, 2) of this mesh"
        )
    if animation.colours is not None and animation.colours.shape != (count, 3):
        raise FaceDiffError(
            f"{animation.name}: its vertex colours have shape {animation.colours.shape}; expected ({count}, 3), sRGB 0 to 255"
        )


def _within(indices: np.ndarray, count: int) -> bool:
    return bool(0 <= indices.min() <= indices.max() < count)


def comparable(animation: Animation, truth: Animation) -> bool:
    """Whether a take has the truth's topology, so that its vertices have errors."""
    return animation.triangles.shape == truth.triangles.shape and bool((animation.triangles == truth.triangles).all())


# The speech of a page: 16-bit PCM in a WAVE file, which every browser plays and seeks to the sample.


def first_sound(takes: Sequence[Animation]) -> bytes | None:
    """The speech of the first take that has any, exactly as long as the motion, as a .wav; None if all are silent.

    Raises:
        FaceDiffError: if it is not finite.
    """
    for animation in takes:
        sound = animation.sound()
        if sound is not None:
            if not np.isfinite(sound).all():
                raise FaceDiffError(f"{animation.name}: its speech holds NaN or infinity; read the recording anew")
            return to_wav(sound, animation.sample_rate)
    return None


def to_wav(sound: np.ndarray, sample_rate: int) -> bytes:
    """Mono samples (S,), full scale 1, as a .wav file of 16 bits."""
    stream = io.BytesIO()
    with wave.open(stream, "wb") as file:
        file.setnchannels(1)
        file.setsampwidth(2)
        file.setframerate(sample_rate)
        # Readers divide by 32768, so that a 16-bit recording comes back bit by bit.
        file.writeframes(np.clip(np.rint(sound * 32768), -32768, 32767).astype("<i2").tobytes())
    return stream.getvalue()


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


def millimetres(animation: Animation) -> float:
    """Millimetres in one unit of a take's length."""
    return 1000 * metres_per_unit(animation.unit)


def pack_motion(animation: Animation, blobs: Blobs) -> list[int]:
    """Numbers of the blobs that hold a motion, one for every `CHUNK_FRAMES` frames.

    With q[t] the offset from the template in steps of `STEP` mm, rounded, a chunk of k frames holds
    d[0] = q[0] and d[t] = q[t] − q[t−1], modulo 2¹⁶, as z = 2 d for d ≥ 0 and −2 d − 1 below, in the order axis,
    vertex, frame; first the low bytes of all, then the high bytes. Values of one vertex are alike, and next to none
    has a high byte, so that deflate finds little to write.

    Raises:
        FaceDiffError: if a vertex is further from the template than 16 bits can say (1.6 m).
    """
    scale = millimetres(animation) / STEP
    template = np.asarray(animation.template, np.float64)
    numbers = []
    for start in range(0, len(animation.vertices), CHUNK_FRAMES):
        steps = np.rint((np.asarray(animation.vertices[start : start + CHUNK_FRAMES], np.float64) - template) * scale)
        furthest = float(np.abs(steps).max(initial=0))
        if furthest > _LARGEST:
            raise FaceDiffError(
                f"{animation.name}: moves {furthest * STEP / 1000:.3g} m away from its template; give the unit of length "
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


def opening(animation: Animation) -> npt.NDArray[np.float32] | None:
    """The mouth's opening in each frame in mm, (T,): the mean distance of the inner lips' pairs; None if unknown."""
    pairs = animation.inner_lip_pairs
    if pairs is None or not len(pairs):
        return None
    lips = np.asarray(animation.vertices[:, pairs], np.float64)
    distances = np.linalg.norm(lips[:, :, 0] - lips[:, :, 1], axis=2)
    return np.asarray(distances.mean(axis=1) * millimetres(animation), np.float32)


def bounds(animation: Animation) -> tuple[list[float], list[float]]:
    """Centre and half extents (x, y, z) of the template's surface, in mm."""
    shown = np.asarray(animation.template, np.float64)[np.unique(animation.triangles)] * millimetres(animation)
    low, high = shown.min(axis=0), shown.max(axis=0)
    return ((low + high) / 2).round(3).tolist(), ((high - low) / 2).round(3).tolist()


# The colour scale of a page's error heat map.

SHARE = 0.99
"""Share of the errors that the scale covers; what is larger gets the last colour."""
_FRAMES = 200
"""Frames looked at: enough for a percentile, little enough for memory."""
_SMALLEST = 0.1


def scale_end(truth: Animation, others: Sequence[Animation]) -> float:
    """Error in mm that gets the last colour: the 99th percentile of the worst take, rounded up to one digit.

    Args:
        truth: what the others are compared with.
        others: takes of the truth's topology and length.
    """
    chosen = np.unique(np.linspace(0, len(truth.vertices) - 1, _FRAMES).astype(int))
    right = np.asarray(truth.vertices[chosen], np.float64) * millimetres(truth)
    largest = _SMALLEST
    for animation in others:
        errors = np.linalg.norm(
            np.asarray(animation.vertices[chosen], np.float64) * millimetres(animation) - right, axis=2
        )
        largest = max(largest, float(np.quantile(errors, SHARE)))
    return round_up(largest)


def round_up(value: float) -> float:
    """The next number of one digit.

    >>> [round_up(value) for value in (0.1, 0.34, 1.0, 2.1, 7.0, 91.0)]
    [0.1, 0.4, 1.0, 3.0, 7.0, 100.0]
    """
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return round(math.ceil(value / power - 1e-9) * power, 9)
