"""A glb in the making, byte for byte as glTF 2.0 lays it out: plain and sparse accessors, named targets."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np


def pack(gltf: Mapping[str, Any], binary: bytes) -> bytes:
    """Header, JSON chunk padded with spaces, binary chunk padded with zeros."""
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


TYPES = {"float32": 5126, "int16": 5122, "uint16": 5123, "uint8": 5121}


@dataclass
class File:
    """A .glb in the making."""

    content: dict[str, Any] = field(
        default_factory=lambda: {
            "asset": {"version": "2.0", "generator": "elsewhere"},
            "bufferViews": [],
            "accessors": [],
        }
    )
    binary: bytes = b""

    def view(self, data: bytes, **more: object) -> int:
        """Append bytes, four to a word."""
        self.binary += bytes(-len(self.binary) % 4)
        self.content["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more}
        )
        self.binary += data
        return len(self.content["bufferViews"]) - 1

    def add(self, array: np.ndarray, form: str, *, bounds: bool = False, sparse: bool = False, **more: object) -> int:
        """Append an array as an accessor."""
        array = np.ascontiguousarray(array)
        accessor: dict[str, Any] = {"componentType": TYPES[array.dtype.name], "count": len(array), "type": form}
        if sparse:
            moved = np.flatnonzero(np.abs(array).any(axis=1))
            moved = moved if len(moved) else np.array([0])
            accessor["sparse"] = {
                "count": len(moved),
                "indices": {"bufferView": self.view(moved.astype("<u2").tobytes()), "componentType": 5123},
                "values": {"bufferView": self.view(array[moved].tobytes())},
            }
        elif array.dtype == np.int16:  # rows begin at multiples of four bytes
            padded = np.pad(array, ((0, 0), (0, 1)))
            accessor |= {"bufferView": self.view(padded.tobytes(), byteStride=8, **more), "normalized": True}
        else:
            accessor["bufferView"] = self.view(array.tobytes(), **more)
        if bounds:
            columns = array.reshape(len(array), -1)
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.content["accessors"].append(accessor)
        return len(self.content["accessors"]) - 1

    def write(self, path: Path) -> None:
        """Write the file."""
        self.content["buffers"] = [{"byteLength": len(self.binary) + -len(self.binary) % 4}]
        path.write_bytes(pack(self.content, self.binary))


def glb_with_targets(
    neutral: np.ndarray, faces: np.ndarray, deltas: Mapping[str, np.ndarray], *, sparse: bool = False
) -> File:
    """A mesh (V, 3), (F, 3) with a displacement (V, 3) for each name."""
    file = File()
    primitive: dict[str, Any] = {
        "attributes": {"POSITION": file.add(neutral.astype("<f4"), "VEC3")},
        "indices": file.add(faces.astype("<u2").ravel(), "SCALAR"),
        "targets": [{"POSITION": file.add(delta.astype("<f4"), "VEC3", sparse=sparse)} for delta in deltas.values()],
    }
    file.content["meshes"] = [{"primitives": [primitive], "extras": {"targetNames": list(deltas)}}]
    return file
