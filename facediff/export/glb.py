"""glTF 2.0 in one binary file: a mesh whose morph targets are animated.

Source: Khronos Group, glTF 2.0 Specification. Metres, y up, the face looks along +z, as the standard prescribes.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.errors import FaceDiffError
from facediff.export.format import ExportOptions, Format, Space, facts, linear_colours, normals_of, outward
from facediff.registry import export_format

# A motion as few shapes and their weights, all within 0 and 1.
#
# Programs that clamp weights (Blender clamps shape keys to 0 … 1) would break the signed weights of principal components,
# so that every component becomes two shapes: one for its positive and one for its negative half. Between two frames the
# sum of both is linear where the component is, so that nothing is lost there.

Array = npt.NDArray[np.float32]

BLOCK = 3000
"""Coordinates that are looked at in one go; bounds the memory for residuals."""


@dataclass(frozen=True)
class Morphs:
    """Shapes and weights: frame t is ``rest + Σ weights[t, m] · shapes[m]``.

    Attributes:
        shapes: (M, V, 3) offsets from the rest face.
        weights: (T, M) within 0 and 1.
        components: principal components behind them; None where there is a shape for every frame.
    """

    shapes: Array
    weights: Array
    components: int | None


def compress(offsets: Array, tolerance: float) -> Morphs:
    """As few shapes as keep every vertex of every frame within a distance.

    Principal components of the offsets, not centred, so that the rest face stays where all weights are 0; their number
    is found by bisection of the largest error, which is measured on what will be written, rounded to float32. Where
    that takes no fewer shapes than there are frames, every frame becomes a shape, which is exact.

    Args:
        offsets: (T, V, 3) from the rest face.
        tolerance: largest distance of a vertex, in the unit of the offsets.
    """
    frames, vertices, _ = offsets.shape
    flat = offsets.reshape(frames, -1)
    scores, axes = principal(flat)
    halves = (scores > 0).any(0).astype(int) + (scores < 0).any(0)
    low, high, best = 0, int((halves.cumsum() < frames).sum()) + 1, None
    while high - low > 1:  # low components are not enough; high are, once there is a best
        middle = (low + high) // 2
        made = split(scores[:, :middle], axes[:middle])
        if largest_error(flat, *made) <= tolerance:
            high, best = middle, made
        else:
            low = middle
    if best is None and not flat.any():
        best = split(scores[:, :0], axes[:0])
    if best is None:
        return Morphs(offsets, np.eye(frames, dtype=np.float32), None)
    return Morphs(best[1].reshape(-1, vertices, 3), best[0], high)


def principal(flat: Array) -> tuple[Array, Array]:
    """Scores (T, K) and axes (K, 3V), the strongest first, with their product equal to ``flat`` (T, 3V).

    Through the T × T products between frames, since there are far fewer frames than coordinates. Squaring loses
    components weaker than about 1e-7 of the strongest; whoever needs them sees it in the error.
    """
    gram = np.zeros((len(flat), len(flat)))
    for block in _blocks(flat):
        gram += block @ block.T
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1]
    order = order[values[order] > max(values.max(), 0) * 1e-14]
    scores = vectors[:, order]
    axes = np.concatenate([scores.T @ block for block in _blocks(flat)], axis=1)
    return scores.astype(np.float32), axes.astype(np.float32)


def split(scores: Array, axes: Array) -> tuple[Array, Array]:
    """Weights (T, M) within 0 and 1 and shapes (M, 3V): the halves that occur of every component."""
    weights, shapes = [], []
    for score, axis in zip(scores.T, axes, strict=True):
        for sign in (1, -1):
            half = np.maximum(sign * score, 0)
            peak = half.max(initial=0)
            if peak > 0:
                weights.append(half / peak)
                shapes.append(sign * peak * axis)
    if not weights:  # a face that never leaves its rest still needs something to animate
        return np.zeros((len(scores), 1), np.float32), np.zeros((1, axes.shape[1]), np.float32)
    return np.stack(weights, 1), np.stack(shapes)


def largest_error(flat: Array, weights: Array, shapes: Array) -> float:
    """Largest distance of a vertex between ``flat`` (T, 3V) and what weights and shapes give."""
    worst = 0.0
    for start in range(0, flat.shape[1], BLOCK):
        left = flat[:, start : start + BLOCK] - weights @ shapes[:, start : start + BLOCK]
        worst = max(worst, float(np.square(left).reshape(len(flat), -1, 3).sum(-1).max()))
    return float(np.sqrt(worst))


def normal_shapes(weights: Array, rest: Array, normals: Callable[[int], Array]) -> Array:
    """Offsets of normals (M, V, 3) that come nearest to the true normals over all frames, with the shapes' weights.

    Normals are no linear function of the vertices, so that the normals of the shapes themselves would not add up;
    least squares over the frames are nearest. Weak directions are left out, since they would only fit noise.

    Args:
        weights: (T, M).
        rest: (V, 3) normals of the rest face.
        normals: the normals (V, 3) of a frame.
    """
    inverse = np.linalg.pinv(weights.astype(np.float64), rcond=1e-2).astype(np.float32)
    made = np.zeros((len(inverse), *rest.shape), np.float32)
    step = 16
    for start in range(0, len(weights), step):
        batch = np.stack([normals(index) - rest for index in range(start, min(start + step, len(weights)))])
        made += np.tensordot(inverse[:, start : start + step], batch, axes=1)
    return made


def _blocks(flat: Array) -> Iterator[npt.NDArray[np.float64]]:
    for start in range(0, flat.shape[1], BLOCK):
        yield flat[:, start : start + BLOCK].astype(np.float64)


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


@export_format.register("glb")
class Glb(Format):
    """glTF 2.0 with morph targets: Blender, Unity, three.js, Unreal."""

    next_step = "Blender: File > Import > glTF 2.0, then play; other programs: docs/export.md"
    speech = "next to it"
    units = "m"
    up_axes = ("y",)

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write one animation."""
        (animation,) = animations
        space = Space.of(animation, options, "m")
        rest = space.place(animation.template)
        offsets = np.stack([frame - rest for frame in space.frames(animation)])
        morphs = compress(offsets, options.tolerance_mm / 1000)
        binary = Binary()
        document = describe(animation, space, rest, morphs, binary)
        told = document["nodes"][0]["extras"]
        told["tolerance_mm"] = 0.0 if morphs.components is None else options.tolerance_mm
        if options.speech_file is not None:
            told["speech"] = options.speech_file
        write_container(path, document, binary)


def describe(
    animation: Animation, space: Space, rest: npt.NDArray[np.float32], morphs: Morphs, binary: Binary
) -> dict[str, Any]:
    """The glTF document; fills the binary part."""
    faces = outward(animation)
    rest_normals = normals_of(rest, faces)
    attributes = {
        "POSITION": binary.add(rest, target=ARRAY_BUFFER, bounds=True),
        "NORMAL": binary.add(rest_normals, target=ARRAY_BUFFER),
    }
    if animation.colours is not None:
        attributes["COLOR_0"] = binary.add(linear_colours(animation.colours), target=ARRAY_BUFFER)
    # The largest number of a type would restart a strip of triangles.
    kind = np.uint16 if len(rest) < 65_535 else np.uint32
    indices = binary.add(faces.astype(kind).ravel(), target=ELEMENT_ARRAY_BUFFER)

    def normals(index: int) -> npt.NDArray[np.float32]:
        return normals_of(space.place(np.asarray(animation.vertices[index])), faces)

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
    times = (np.arange(len(animation.vertices)) / animation.frame_rate).astype(np.float32)
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
        "nodes": [{"name": animation.name, "mesh": 0, "extras": facts(animation, space)}],
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
                | ({} if animation.colours is not None else {"baseColorFactor": [0.6, 0.6, 0.6, 1.0]}),
            }
        ],
        "animations": [
            {
                "name": animation.name,
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
