"""Motion of other projects: changing its frame rate, and reading its FLAME parameters."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.mesh.flame import EXPRESSIONS, SHAPES
from facediff.utils.arrays import open_array
from facediff.utils.hdf5 import HDF5_SUFFIXES, as_frames, read_frames

# Changing the frame rate of motion without aliasing.

CROSSINGS = 24  # zero crossings of the filter on each side
BAND = 0.9  # where the filter has fallen to one half, as a share of the lower one of the two Nyquist frequencies
KAISER = 8.0  # window: the stop band lies 80 dB down, the transition is a tenth of the Nyquist frequency wide
BLOCK = 64  # frames that are computed at a time


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
    Beyond its ends the motion is continued by reflection in its first and last frame, which keeps its slope there.
    ``motion`` and ``out`` may be memory-mapped: a block of frames is in memory at a time.

    Args:
        motion: (T, C) coordinates over time; further dimensions are allowed.
        rate_in: frames a second of ``motion``.
        rate_out: frames a second of the result.
        out: where to write, shape (round(T · rate_out / rate_in), C); a new array of ``motion``'s type if None.
    """
    length = resampled_length(len(motion), rate_in, rate_out)
    out = np.empty((length, *motion.shape[1:]), motion.dtype) if out is None else out
    if rate_in == rate_out:
        for first in range(0, length, BLOCK):
            out[first : first + BLOCK] = motion[first : first + BLOCK]
        return out
    for target, source, weights in _blocks(len(motion), length, rate_in, rate_out):
        rows = np.asarray(motion[source], np.float64)
        out[target] = (weights @ rows.reshape(len(rows), -1)).reshape(-1, *motion.shape[1:])
    return out


def _blocks(
    frames: int, length: int, rate_in: float, rate_out: float
) -> Iterator[tuple[slice, slice, npt.NDArray[np.float64]]]:
    """Frames to write, frames that they depend on, and the matrix from these to those."""
    step = rate_in / rate_out
    band = BAND * min(1.0, rate_out / rate_in)
    reach = CROSSINGS / band
    for first in range(0, length, BLOCK):
        times = np.arange(first, min(first + BLOCK, length)) * step
        sources = np.arange(math.floor(times[0] - reach), math.ceil(times[-1] + reach) + 1)
        distances = times[:, None] - sources
        window = np.i0(KAISER * np.sqrt(np.clip(1.0 - np.square(distances / reach), 0.0, None)))
        weights = np.where(np.abs(distances) < reach, np.sinc(band * distances) * window, 0.0)
        weights /= weights.sum(axis=1, keepdims=True)
        yield (slice(first, first + len(times)), *_reflected(weights, sources, frames))


def _reflected(
    weights: npt.NDArray[np.float64], sources: npt.NDArray[np.int64], frames: int
) -> tuple[slice, npt.NDArray[np.float64]]:
    """Weights of frames that exist: a frame beyond an end is twice the end minus its mirror image.

    In motion shorter than the filter, a mirror image beyond the other end is clipped to that end.
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


# FLAME parameters of one clip as reconstruction projects write them.
#
# EMOTE (Daněček et al. 2023, the inferno repository) has the datasets ``shape`` (1, T, 300), ``exp`` (1, T, 100) and
# ``jaw`` (1, T, 3); older files were written by hickle, which puts them into the group ``data`` and quotes their names.
# ProbTalk3D (Wu et al. 2024) has one array (1, T, 403) with the three side by side.

WIDTHS = {"shape": SHAPES, "exp": EXPRESSIONS, "jaw": 3}
FLAME_WIDTH = sum(WIDTHS.values())

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class FlameParameters:
    """Mean shape (S,), expression (T, E) and rotation of the jaw (T, 3), axis-angle in radians, of a clip."""

    shape: Array
    expression: Array
    jaw: Array


def read_parameters(path: Path) -> FlameParameters:
    """Read a clip's parameters: ``shape_pose_cam.hdf5`` of EMOTE (flat or by hickle), or ProbTalk3D's ``.npy``.

    The shape is the mean over all frames with equal weights, since these files do not say how well the face was seen
    in each. Rotation of the head and the camera are left out.
    """
    parts = read_frames(path, WIDTHS) if path.suffix.lower() in HDF5_SUFFIXES else _read_array(path)
    frames = len(parts["exp"])
    finite = all(np.isfinite(values).all() for values in parts.values())
    if not finite or len(parts["jaw"]) != frames or len(parts["shape"]) not in (1, frames):
        counts = ", ".join(f"{len(values)} of {name}" for name, values in parts.items())
        raise FaceDiffError(f"{path}: holds NaN or infinity, or its frames do not agree ({counts}); get it again")
    return FlameParameters(parts["shape"].mean(axis=0), parts["exp"], parts["jaw"])


def _read_array(path: Path) -> dict[str, Array]:
    joined = as_frames(open_array(path, kinds="f"), FLAME_WIDTH, f"{path}: the array", exact=True)
    ends = np.cumsum(list(WIDTHS.values()))
    return dict(zip(WIDTHS, np.split(joined, ends[:-1], axis=1), strict=True))
