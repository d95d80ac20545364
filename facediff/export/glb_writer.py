"""A glTF 2.0 document with its arrays, written as one binary file.

Source: Khronos Group, glTF 2.0 Specification, sections 3.6 (binary data) and 4.4 (GLB).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.files import atomic

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
COMPONENT_TYPES = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123}
LIMIT = 2**32 - 1  # The most bytes that the header of a .glb can count


class GlbWriter:
    """A document with arrays appended to its binary chunk.

    Args:
        content: the document; its present content stays.
        binary: the binary chunk that it has already.
    """

    def __init__(self, content: dict[str, Any], binary: bytes = b"") -> None:
        self.content = content
        self._parts: list[bytes] = []
        self._length = 0
        self._append(binary)
        for name in ("bufferViews", "accessors"):
            content.setdefault(name, [])
        if not content.get("buffers"):
            content["buffers"] = [{"byteLength": 0}]

    def _append(self, data: bytes) -> None:
        # Every array begins at a multiple of four bytes, as accessors of floats and whole numbers must.
        self._parts += [data, bytes(-len(data) % 4)]
        self._length += len(data) + len(self._parts[-1])

    def add(self, array: npt.NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (N,) or (N, 2 to 4) and return its accessor's number.

        Args:
            array: float32, uint16 or uint32.
            target: its use by a graphics card, such as ``ARRAY_BUFFER``.
            bounds: whether the least and the greatest numbers are written, as positions and times need.
        """
        array = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        accessor: dict[str, Any] = {
            "bufferView": self.add_bytes(array.tobytes(), target=target),
            "componentType": COMPONENT_TYPES[array.dtype],
            "count": len(array),
            "type": "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}",
        }
        if bounds:
            columns = array.reshape(len(array), -1)
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def add_bytes(self, data: bytes, *, target: int | None = None) -> int:
        """Append bytes, such as a picture's, and return the number of their view."""
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": len(data)}
        self.content["bufferViews"].append(view if target is None else {**view, "target": target})
        self._append(data)
        return len(self.content["bufferViews"]) - 1

    def write(self, path: Path) -> None:
        """Write the header, the JSON chunk and the binary chunk, each padded to four bytes."""
        self.content["buffers"][0]["byteLength"] = self._length
        text = json.dumps(self.content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + self._length
        if length > LIMIT:
            raise FaceDiffError(
                f"{path}: would have {length / 2**30:.1f} GiB, and a .glb may have 4; export a shorter part, or .usdc"
            )
        with atomic(path) as temporary, temporary.open("wb") as stream:
            stream.write(struct.pack("<4sII", b"glTF", 2, length))
            stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
            stream.write(struct.pack("<I4s", self._length, b"BIN\0"))
            # Part by part: joined first, 252 MB of targets would take twice the memory.
            stream.writelines(self._parts)
