"""Arrays on disk that are needed while importing only."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt


def scratch_array(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """A new memory-mapped float32 array."""
    array: npt.NDArray[np.float32] = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
    return array
