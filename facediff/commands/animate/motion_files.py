"""Motion that is written to a .npy file while it is made, so that memory does not hold it."""

from __future__ import annotations

from pathlib import Path
from typing import IO, TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

HEADER = 128
"""Bytes of a NumPy header for up to 10^21 elements (NumPy pads it to a multiple of 64)."""


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
        self._stream: IO[bytes] = path.open("wb")
        self._stream.write(self._header())

    def write(self, vertices: npt.NDArray[np.float32]) -> None:
        """Add frames (n, V, 3)."""
        self._stream.write(vertices.astype("<f4", copy=False).tobytes())
        self.frames += len(vertices)

    def close(self) -> None:
        """Write how many frames there are."""
        self._stream.seek(0)
        self._stream.write(self._header())
        self._stream.close()

    def _header(self) -> bytes:
        """Version 1.0 of the format: magic, length, a dictionary padded with blanks, a line's end."""
        facts = f"{{'descr': '<f4', 'fortran_order': False, 'shape': {(self.frames, *self.frame)}, }}"
        length = HEADER - 10
        return b"\x93NUMPY\x01\x00" + length.to_bytes(2, "little") + facts.encode("latin1").ljust(length - 1) + b"\n"
