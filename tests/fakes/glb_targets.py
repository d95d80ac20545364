"""A glb with named targets, byte for byte as glTF 2.0 lays it out: plain and sparse accessors, 16-bit indices."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np


def pack(gltf: Mapping[str, Any], binary: bytes) -> bytes:
    """Header, JSON chunk padded with spaces, binary chunk padded with zeros."""
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<III", 0x46546C67, 2, 12 + len(body)) + body


def glb_with_targets(
    neutral: np.ndarray, faces: np.ndarray, deltas: Mapping[str, np.ndarray], *, sparse: bool = False
) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a mesh (V, 3), (F, 3) with a displacement (V, 3) for each name."""
    binary = b""
    gltf: dict[str, Any] = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}

    def view(data: bytes) -> int:
        nonlocal binary
        binary += b"\0" * (-len(binary) % 4)
        gltf["bufferViews"].append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        binary += data
        return len(gltf["bufferViews"]) - 1

    def accessor(component: int, kind: str, count: int, **more: object) -> int:
        gltf["accessors"].append({"componentType": component, "type": kind, "count": count, **more})
        return len(gltf["accessors"]) - 1

    position = accessor(5126, "VEC3", len(neutral), bufferView=view(neutral.astype("<f4").tobytes()))
    corners = accessor(5123, "SCALAR", faces.size, bufferView=view(faces.astype("<u2").tobytes()))
    targets = []
    for delta in deltas.values():
        if sparse:
            moved = np.flatnonzero(np.abs(delta).any(axis=1))
            told = {
                "count": len(moved),
                "indices": {"bufferView": view(moved.astype("<u2").tobytes()), "componentType": 5123},
                "values": {"bufferView": view(delta[moved].astype("<f4").tobytes())},
            }
            targets.append({"POSITION": accessor(5126, "VEC3", len(neutral), sparse=told)})
        else:
            data = view(delta.astype("<f4").tobytes())
            targets.append({"POSITION": accessor(5126, "VEC3", len(neutral), bufferView=data)})
    gltf["meshes"] = [
        {
            "primitives": [{"attributes": {"POSITION": position}, "indices": corners, "targets": targets}],
            "extras": {"targetNames": list(deltas)},
        }
    ]
    gltf["buffers"] = [{"byteLength": len(binary)}]
    return gltf, binary
