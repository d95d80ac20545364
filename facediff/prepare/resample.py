"""Changing the frame rate of motion without aliases."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

CROSSINGS = 24
"""Zero crossings of the filter on each side."""
BAND = 0.9
"""Where the filter has fallen to one half, as a share of the lower one of the two Nyquist frequencies."""
KAISER = 8.0
"""Shape of the window: the stop band lies 80 dB down, the transition is a tenth of the Nyquist frequency wide."""
BLOCK = 64
"""Frames that are made at a time."""


def resampled_length(frames: int, rate_in: float, rate_out: float) -> int:
    """Frames at the new rate that last as long as ``frames`` at the old one, rounded."""
    return round(frames * rate_out / rate_in)


def resample_frames(
    motion: npt.NDArray[np.floating],
    rate_in: float,
    rate_out: float,
    *,
    out: npt.NDArray[np.floating] | None = None,
) -> npt.NDArray[np.floating]:
    """Motion at another frame rate, low-pass filtered; frame k of the result is at time k / ``rate_out``.

    Frame 0 stays frame 0. The filter is a sinc under a Kaiser window (Smith, "Digital Audio Resampling", 2002),
    evaluated at every output frame's exact time, so any ratio of rates will do (29.97 to 25), and constants are kept.
    Beyond its ends the motion goes on reflected in its first and last frame, which keeps its slope there. ``motion``
    and ``out`` may be memory-mapped: a block of frames is in memory at a time.

    Args:
        motion: (T, C) coordinates over time; further dimensions are allowed.
        rate_in: frames a second of ``motion``.
        rate_out: frames a second of the result.
        out: where to write, shape (round(T · rate_out / rate_in), C); a new array of ``motion``'s type if None.

    Returns:
        the resampled motion.

    Raises:
        FaceDiffError: if a rate is not positive, or there is no frame to give out.
    """
    if not (rate_in > 0 and rate_out > 0 and math.isfinite(rate_in) and math.isfinite(rate_out)):
        raise FaceDiffError(f"frame rates {rate_in:g} and {rate_out:g}: expected positive numbers of frames a second")
    length = resampled_length(len(motion), rate_in, rate_out)
    if length < 1:
        raise FaceDiffError(
            f"motion of {len(motion)} frames at {rate_in:g} frames a second: too short for {rate_out:g} frames a second"
        )
    shape = (length, *motion.shape[1:])
    if out is None:
        out = np.empty(shape, motion.dtype)
    if out.shape != shape:
        raise FaceDiffError(f"resampling: out has shape {out.shape}, expected {shape}")
    if rate_in == rate_out:
        for first in range(0, length, BLOCK):
            out[first : first + BLOCK] = motion[first : first + BLOCK]
        return out
    for made, used, weights in _blocks(len(motion), length, rate_in, rate_out):
        rows = np.asarray(motion[used], np.float64)
        out[made] = (weights @ rows.reshape(len(rows), -1)).reshape(-1, *motion.shape[1:])
    return out


def _blocks(
    frames: int, length: int, rate_in: float, rate_out: float
) -> Iterator[tuple[slice, slice, npt.NDArray[np.float64]]]:
    """Frames to make, frames to make them from, and the matrix that does it."""
    step = rate_in / rate_out
    band = BAND * min(1.0, rate_out / rate_in)
    reach = CROSSINGS / band
    for first in range(0, length, BLOCK):
        times = np.arange(first, min(first + BLOCK, length)) * step
        sources = np.arange(math.floor(times[0] - reach), math.ceil(times[-1] + reach) + 1)
        weights = _filter(times[:, None] - sources, band, reach)
        weights /= weights.sum(axis=1, keepdims=True)
        yield (slice(first, first + len(times)), *_reflected(weights, sources, frames))


def _filter(distance: npt.NDArray[np.floating], band: float, reach: float) -> npt.NDArray[np.float64]:
    """The windowed sinc at distances in input frames."""
    inside = np.sqrt(np.clip(1.0 - np.square(distance / reach), 0.0, None))
    weights: npt.NDArray[np.float64] = np.where(
        np.abs(distance) < reach, np.sinc(band * distance) * np.i0(KAISER * inside), 0.0
    )
    return weights


def _reflected(
    weights: npt.NDArray[np.float64], sources: npt.NDArray[np.int64], frames: int
) -> tuple[slice, npt.NDArray[np.float64]]:
    """Weights of frames that exist: a frame beyond an end is twice the end minus its mirror image.

    What reaches beyond the other end, in motion shorter than the filter, stops there.
    """
    last = frames - 1
    mirrored = np.where(sources < 0, -sources, np.where(sources > last, 2 * last - sources, sources)).clip(0, last)
    first, stop = int(mirrored.min()), int(mirrored.max()) + 1
    before, after = sources < 0, sources > last
    if before.any():
        first = 0
    if after.any():
        stop = frames
    folded = np.zeros((len(weights), stop - first))
    sign = np.where(before | after, -1.0, 1.0)
    np.add.at(folded.T, mirrored - first, (sign * weights).T)
    if before.any():
        folded[:, 0] += 2.0 * weights[:, before].sum(axis=1)
    if after.any():
        folded[:, -1] += 2.0 * weights[:, after].sum(axis=1)
    return slice(first, stop), folded
