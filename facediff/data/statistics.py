"""What is measured on the training motion before training: its size and its principal components."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from facediff.data.corpus import Clip, Corpus
from facediff.errors import FaceDiffError

FRAMES = 16
"""Frames of each training clip, evenly spread, that are looked at."""

PRINCIPAL_NUMBERS = 30_000_000
"""Coordinates from which principal components are computed, about; bounds the memory (8 bytes each, twice)."""


def motion_scale(corpus: Corpus, clips: Sequence[Clip]) -> float:
    """Factor that gives motion unit variance: one over the root mean square of its coordinates.

    Offsets from the template are centred near zero.

    Args:
        corpus: where the clips are.
        clips: the training clips.

    Raises:
        FaceDiffError: if they hold no motion at all.
    """
    total, count = 0.0, 0
    for motion in spread_frames(corpus, clips, FRAMES):
        total += float(motion.double().square().sum())
        count += motion.numel()
    if not total:
        raise FaceDiffError(f"{corpus.root}: the training split holds no motion at all; check vertices_npy/")
    return float((count / total) ** 0.5)


def principal_motion(corpus: Corpus, clips: Sequence[Clip], count: int) -> tuple[Tensor, Tensor]:
    """Mean and principal components of motion.

    Args:
        corpus: where the clips are.
        clips: the training clips.
        count: at most so many components are given.

    Returns:
        the mean (3V,), and components (at most count, 3V), each as long as its standard deviation, the largest first;
        in the corpus's unit.
    """
    most = max(2, PRINCIPAL_NUMBERS // (3 * corpus.n_vertices * max(1, len(clips))))
    frames = torch.cat([motion.flatten(1) for motion in spread_frames(corpus, clips, min(most, FRAMES))]).double()
    mean = frames.mean(0)
    frames -= mean
    # Of the frames' own products: a matrix as wide as the vertices would not fit into memory.
    values, vectors = torch.linalg.eigh(frames @ frames.T)
    kept = [i for i in reversed(range(len(values))) if values[i] > 1e-10 * values[-1]][:count]
    shapes = vectors[:, kept].T @ frames / len(frames) ** 0.5
    return mean.float(), shapes.float()


def spread_frames(corpus: Corpus, clips: Sequence[Clip], count: int) -> Iterator[Tensor]:
    """At most ``count`` evenly spread frames of every clip, one at a time (1, V, 3)."""
    for clip in clips:
        frames = corpus.frames(clip)
        for index in torch.linspace(0, frames - 1, min(frames, count)).long().tolist():
            yield corpus.read_motion(clip, index, index + 1)
