"""Motion that is written to a .npy file while it is made, so that memory does not hold it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt


class MotionWriter:
    """A .npy file of (frames, V, 3) float32 that grows; its header is right after :meth:`close`.

    Args:
        path: the file.
        frame: shape of a frame, (V, 3).
    """

    def __init__(self, path: Path, frame: tuple[int, ...]) -> None:
        self.path = path
        self.frame = frame
        self.frames = 0
        self._stream = path.open("wb")
        self._write_header()

    def write(self, vertices: npt.NDArray[np.float32]) -> None:
        """Add frames (n, V, 3)."""
        self._stream.write(np.ascontiguousarray(vertices, "<f4").tobytes())
        self.frames += len(vertices)

    def close(self) -> None:
        """Write how many frames there are."""
        with self._stream:
            self._stream.seek(0)
            self._write_header()

    def _write_header(self) -> None:
        # NumPy leaves room for the first number of a shape to grow, so the header may be written again in its place.
        facts = {"descr": "<f4", "fortran_order": False, "shape": (self.frames, *self.frame)}
        np.lib.format.write_array_header_1_0(self._stream, facts)
