"""Files that scores of conversations read next to a corpus's clips: the partner's motion and who speaks when."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.metrics import Region
from facediff.spaces import Space
from facediff.utils.arrays import open_array

CONVERSATION = {"partner": "f", "speaking": "b"}
"""Folders of a corpus, ``<folder>/<clip>.npy``, and the kind of numbers in their files."""


def conversation_file(root: Path, folder: str, clip: str, stride: int = 1) -> npt.NDArray[Any]:
    """The partner's motion of a clip (frames, channels) as float32, or its mask of speaking frames (frames,).

    Args:
        root: the corpus's folder.
        folder: ``partner`` or ``speaking``.
        clip: the clip's name.
        stride: of so many stored frames, the first is read.
    """
    path = root / folder / f"{clip}.npy"
    array = open_array(path, kinds=CONVERSATION[folder])
    dimensions = 2 if folder == "partner" else 1
    if array.ndim != dimensions:
        expected = "(frames, channels)" if folder == "partner" else "a boolean for each frame"
        raise FaceDiffError(f"{path}: has shape {array.shape}; expected {expected}")
    return np.array(array[::stride], np.float32 if folder == "partner" else np.bool_)


def channel_regions(space: Space) -> dict[str, Region]:
    """The groups of a space's channels by name, for metrics; empty for vertices."""
    count = len(space.channels)
    groups = {} if space.is_vertices else space.groups
    return {name: Region.from_indices(name, indices, n_vertices=count) for name, indices in groups.items() if indices}
