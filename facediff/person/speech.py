"""What is done by the loudness of speech: finding frames of a neutral face, and cutting into clips."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.data.audio import SAMPLE_RATE

Array = npt.NDArray[np.float64]
Speech = npt.NDArray[np.float32]

SMOOTHING = 0.2
"""Seconds over which loudness is averaged."""
NEUTRAL_SHARE = 0.05
"""Share of the frames that the neutral face is the median of."""
NEUTRAL_FRAMES = (5, 50)
"""At least and at most so many."""
SLACK = 0.25
"""How far a cut may lie from an equal division, as a share of a clip."""


def loudness(speech: Speech, frames: int, frame_rate: float) -> Array:
    """Root-mean-square loudness around every frame (T,), averaged over 0.2 s."""
    energy = np.concatenate([[0.0], np.cumsum(np.square(speech, dtype=np.float64))])
    middle = (np.arange(frames) + 0.5) / frame_rate
    low, high = (
        np.clip(((middle + side * SMOOTHING / 2) * SAMPLE_RATE).round().astype(int), 0, len(speech)) for side in (-1, 1)
    )
    return np.sqrt((energy[high] - energy[low]) / np.maximum(high - low, 1))


def neutral_frames(loud: Array, speed: Array) -> npt.NDArray[np.int64]:
    """The twentieth of the frames in which speech is quiet and the face is still, both; sorted indices.

    Frames are ranked by loudness and by speed; those whose worse rank is best are taken.
    """
    worse = np.maximum(*(np.searchsorted(np.sort(values), values) for values in (loud, speed)))
    least, most = NEUTRAL_FRAMES
    count = min(len(loud), max(least, min(most, round(NEUTRAL_SHARE * len(loud)))))
    return np.sort(np.argsort(worse, kind="stable")[:count])


def cut_points(loud: Array, clip_frames: float) -> list[tuple[int, int]]:
    """Divide frames into clips of about equal length, each cut at the quietest frame near its place.

    Args:
        loud: (T,) loudness.
        clip_frames: wanted length of a clip, in frames.

    Returns:
        first frame and frame after the last of every clip; together they are all frames.
    """
    clips = max(1, round(len(loud) / clip_frames))
    length = len(loud) / clips
    cuts = [0]
    for i in range(1, clips):
        first = max(cuts[-1] + 1, round((i - SLACK) * length))
        window = loud[first : max(first + 1, round((i + SLACK) * length))]
        quiet = np.flatnonzero(window == window.min())
        cuts.append(first + int(quiet[len(quiet) // 2]))  # the middle of a pause, where it is wholly silent
    return list(zip(cuts, [*cuts[1:], len(loud)], strict=True))


def splits(clips: int) -> list[str]:
    """Split of every clip: the last 15 % ``test``, the 10 % before them ``val``, the rest ``train``.

    With four clips or more there is at least one of each; fewer are all ``train``.
    """
    if clips < 4:
        return ["train"] * clips
    test, val = max(1, round(0.15 * clips)), max(1, round(0.10 * clips))
    return ["train"] * (clips - val - test) + ["val"] * val + ["test"] * test
