"""glTF 2.0 in one binary file: a mesh whose morph targets are animated.

Source: Khronos Group, glTF 2.0 Specification. Metres, y up, the face looks along +z, as the standard prescribes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.export.format import Format, Space, facts
from facediff.export.morph import Morphs, compress, normal_shapes
from facediff.export.options import ExportOptions
from facediff.export.sound import write_wav
from facediff.export.surface import linear_colours, normals_of, outward
from facediff.takes import Take

ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
TYPES = {np.dtype("<f4"): 5126, np.dtype("<u4"): 5125, np.dtype("<u2"): 5123}
LIMIT = 2**32 - 1
"""Bytes that the header of a .glb can count."""


class Binary:
    """The binary part and the accessors into it; every array gets a view of its own, so that all are aligned."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.length = 0
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, array: npt.NDArray[Any], *, target: int | None = None, bounds: bool = False) -> int:
        """Append an array (N,) or (N, components); gives the accessor's number."""
        array = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        data = array.tobytes()
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self.length, "byteLength": len(data)}
        self.views.append(view | ({} if target is None else {"target": target}))
        columns = array[:, None] if array.ndim == 1 else array
        accessor: dict[str, Any] = {
            "bufferView": len(self.views) - 1,
            "componentType": TYPES[array.dtype],
            "count": len(array),
            "type": {1: "SCALAR", 3: "VEC3"}[columns.shape[1]],
        }
        if bounds:
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.accessors.append(accessor)
        data += bytes(-len(data) % 4)
        self.parts.append(data)
        self.length += len(data)
        return len(self.accessors) - 1


def write(path: Path, takes: Sequence[Take], options: ExportOptions, sound: str | None) -> None:
    """Write one take as .glb, and its speech beside it, since glTF holds no sound."""
    (take,) = takes
    space = Space.of(take, options, "m")
    rest = space.place(take.template)
    offsets = np.stack([frame - rest for frame in space.frames(take)])
    morphs = compress(offsets, options.tolerance_mm / 1000)
    binary = Binary()
    document = describe(take, space, rest, morphs, binary)
    told = document["nodes"][0]["extras"]
    told["tolerance_mm"] = 0.0 if morphs.components is None else options.tolerance_mm
    if sound is not None:
        write_wav(path.with_name(sound), take)
        told["speech"] = sound
    write_container(path, document, binary)


def describe(take: Take, space: Space, rest: npt.NDArray[np.float32], morphs: Morphs, binary: Binary) -> dict[str, Any]:
    """The glTF document; fills the binary part."""
    faces = outward(take)
    rest_normals = normals_of(rest, faces)
    attributes = {
        "POSITION": binary.add(rest, target=ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.add(rest_normals, target=ARRAY_BUFFER),
    }
    if take.colours is not None:
        attributes["COLOR_0"] = binary.add(linear_colours(take.colours), target=ARRAY_BUFFER)
    # The largest number of a type would restart a strip of triangles.
    kind = np.uint16 if len(rest) < 65_535 else np.uint32
    indices = binary.add(faces.astype(kind).ravel(), target=ELEMENT_ARRAY_BUFFER)

    def normals(index: int) -> npt.NDArray[np.float32]:
        return normals_of(space.place(np.asarray(take.vertices[index])), faces)

    turned = normal_shapes(morphs.weights, rest_normals, normals)
    targets = [
        {
            "POSITION": binary.add(shape, target=ARRAY_BUFFER, bounds=True),
            "NORMAL": binary.add(normal, target=ARRAY_BUFFER),
        }
        for shape, normal in zip(morphs.shapes, turned, strict=True)
    ]
    prefix = "frame" if morphs.components is None else "shape"
    names = [f"{prefix}_{index:04d}" for index in range(len(targets))]
    times = (np.arange(len(take.vertices)) / take.frame_rate).astype(np.float32)
    animated = {
        "input": binary.add(times, bounds=True),
        "output": binary.add(morphs.weights.ravel()),
        "interpolation": "LINEAR",
    }
    primitive = {"attributes": attributes, "indices": indices, "material": 0, "targets": targets}
    return {
        "asset": {"version": "2.0", "generator": "facediff"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": take.name, "mesh": 0, "extras": facts(take, space)}],
        "meshes": [
            {
                "name": "face",
                "primitives": [primitive],
                "weights": [0.0] * len(targets),
                "extras": {"targetNames": names},
            }
        ],
        "materials": [
            {
                "name": "face",
                "doubleSided": True,
                "pbrMetallicRoughness": {"metallicFactor": 0.0, "roughnessFactor": 0.7}
                | ({} if take.colours is not None else {"baseColorFactor": [0.6, 0.6, 0.6, 1.0]}),
            }
        ],
        "animations": [
            {
                "name": take.name,
                "samplers": [animated],
                "channels": [{"sampler": 0, "target": {"node": 0, "path": "weights"}}],
            }
        ],
        "accessors": binary.accessors,
        "bufferViews": binary.views,
        "buffers": [{"byteLength": binary.length}],
    }


def write_container(path: Path, document: dict[str, Any], binary: Binary) -> None:
    """Header, JSON chunk and binary chunk, each filled up to four bytes.

    Raises:
        FaceDiffError: if the file would be larger than its header can say.
    """
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    length = 12 + 8 + len(text) + 8 + binary.length
    if length > LIMIT:
        raise FaceDiffError(
            f"{path}: would have {length / 2**30:.1f} GiB, and a .glb may have 4; write .usdc, or export a shorter part"
        )
    with path.open("wb") as stream:
        stream.write(struct.pack("<4sII", b"glTF", 2, length))
        stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
        stream.write(struct.pack("<I4s", binary.length, b"BIN\0"))
        stream.writelines(binary.parts)


FORMAT = Format(
    help="glTF 2.0 with morph targets: Blender, Unity, three.js, Unreal",
    write=write,
    then="Blender: File > Import > glTF 2.0, then play; other programs: docs/export.md",
    sound_beside=True,
    unit="m",
    ups=("y",),
)
