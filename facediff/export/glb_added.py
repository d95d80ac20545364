"""An animation added to a .glb from elsewhere: further morph targets and their weights; all else in it stays."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation, metres_per_unit
from facediff.errors import FaceDiffError
from facediff.export.glb import LIMIT, compress
from facediff.mesh.glb import Glb, open_glb, placed_meshes
from facediff.utils.files import atomic

FLOAT = 5126  # glTF's code of float32
STILL = 1e-7  # A mesh that moves by less than this share of its size stands still


def add_to_glb(path: Path, target: Path, animation: Animation, tolerance_mm: float) -> None:
    """Write a copy of a .glb in which the meshes of an animation move.

    The parts of the file that move get further morph targets after their own, whose default weights stay, and one
    animation drives them. Texture coordinates, materials, images, skins, nodes, extensions and other animations
    are written as they are; an animation of a moving mesh's own weights gets zeros for the new targets.

    Args:
        path: the file to write.
        target: the .glb that the animation's mesh was read from.
        animation: on that mesh, vertex by vertex.
        tolerance_mm: largest distance of a vertex from the animation's, in millimetres.

    Raises:
        FaceDiffError: if the file is no readable .glb, is not the mesh of the animation, or shows one of its moving
            meshes in several places.
    """
    try:
        glb = open_glb(target)
        changed = _Changed(glb)
        moved = [part for part in _parts(glb) if part.count]
        total = sum(part.count for part in moved)
        if total != len(animation.template):
            raise FaceDiffError(
                f"{target}: has {total} vertices and the animation {len(animation.template)}; give the file that the "
                f"animation was carried to"
            )
        rest = np.asarray(animation.template, np.float64)
        offsets = np.stack([np.asarray(frame, np.float64) - rest for frame in animation.frames()]).astype(np.float32)
        morphs = compress(offsets, tolerance_mm / 1000 / metres_per_unit(animation.unit))
        _animate(glb, changed, moved, np.asarray(morphs.shapes, np.float64), morphs.weights, animation)
    except (ValueError, IndexError, KeyError, TypeError) as error:
        raise FaceDiffError(f"{target}: not a readable GLB mesh ({error}); export it again") from error
    changed.write(path)


class _Part:
    """One primitive of a mesh where a node places it."""

    def __init__(
        self, mesh: int, node: int, primitive: dict[str, Any], count: int, turn: npt.NDArray[np.float64]
    ) -> None:
        self.mesh, self.node, self.primitive, self.count, self.turn = mesh, node, primitive, count, turn


def _parts(glb: Glb) -> list[_Part]:
    """All primitives in the order in which `read_mesh` joins them; the count of those without triangles is 0."""
    found = []
    for mesh, matrix, node in placed_meshes(glb):
        turn = np.eye(3) if matrix is None else matrix[:3, :3]
        for primitive in glb.primitives(mesh):
            count = len(glb.positions(primitive))
            count = count if len(glb.triangles(primitive, count)) else 0
            found.append(_Part(mesh, node, primitive, count, turn))
    return found


def _animate(
    glb: Glb,
    changed: _Changed,
    parts: list[_Part],
    shapes: npt.NDArray[np.float64],
    weights: npt.NDArray[np.float32],
    animation: Animation,
) -> None:
    times = changed.add((np.arange(len(weights)) / animation.frame_rate).astype(np.float32), "SCALAR", bounds=True)
    own: dict[str, Any] = {"name": animation.name, "samplers": [], "channels": []}
    begins = np.cumsum([0, *(part.count for part in parts)])
    size = float(np.ptp(animation.template, axis=0).max())
    moving = {
        part.mesh
        for part, first in zip(parts, begins, strict=False)
        if np.abs(shapes[:, first : first + part.count]).max(initial=0) > STILL * size
    }
    for mesh in sorted(moving):
        nodes = sorted({part.node for part in parts if part.mesh == mesh})
        if len(nodes) > 1:
            raise ValueError(f"its mesh {mesh} moves and is shown by {len(nodes)} nodes: make it a mesh of each")
        entry = glb.entry("meshes", mesh)
        before = max(len(glb.entries("targets", primitive)) for primitive in glb.primitives(mesh))
        done = {}
        for part, first in zip(parts, begins, strict=False):
            if part.mesh == mesh:
                back = np.linalg.inv(part.turn).T
                done[id(part.primitive)] = [
                    changed.add((shape @ back).astype(np.float32), "VEC3", bounds=True)
                    for shape in shapes[:, first : first + part.count]
                ]
        for primitive in glb.primitives(mesh):
            count = len(glb.positions(primitive))
            numbers = done.get(id(primitive)) or [
                changed.add(np.zeros((count, 3), np.float32), "VEC3", bounds=True) for _ in shapes
            ]
            primitive["targets"] = [*glb.entries("targets", primitive), *({"POSITION": each} for each in numbers)]
        default = [float(each) for each in entry.get("weights", [0.0] * before)]
        entry["weights"] = [*default, *[0.0] * len(shapes)]
        node = glb.entry("nodes", nodes[0])
        if "weights" in node:
            default = [float(each) for each in node["weights"]]
            node["weights"] = [*default, *[0.0] * len(shapes)]
        extras = entry.setdefault("extras", {})
        names = list(extras.get("targetNames", [f"target_{k}" for k in range(before)]))
        extras["targetNames"] = [*names, *(f"facediff_{k:04d}" for k in range(len(shapes)))]
        _pad_others(glb, changed, nodes[0], before, len(shapes))
        rows = np.concatenate([np.tile(np.array(default, np.float32), (len(weights), 1)), weights], axis=1)
        own["samplers"].append(
            {"input": times, "output": changed.add(rows.ravel(), "SCALAR"), "interpolation": "LINEAR"}
        )
        own["channels"].append({"sampler": len(own["samplers"]) - 1, "target": {"node": nodes[0], "path": "weights"}})
    if own["channels"]:
        glb.content["animations"] = [*glb.entries("animations"), own]


def _pad_others(glb: Glb, changed: _Changed, node: int, before: int, more: int) -> None:
    """Give the file's own animations of a node's weights zeros for the new targets."""
    for animation in glb.entries("animations"):
        samplers = glb.entries("samplers", animation)
        for channel in glb.entries("channels", animation):
            goal = channel.get("target", {})
            if goal.get("node") == node and goal.get("path") == "weights" and before:
                sampler = dict(samplers[channel["sampler"]])
                values = glb.numbers(sampler["output"], "SCALAR", ("f4", "i1", "u1", "i2", "u2")).reshape(-1, before)
                padded = np.pad(values.astype(np.float32), ((0, 0), (0, more)))
                sampler["output"] = changed.add(padded.ravel(), "SCALAR")
                samplers.append(sampler)
                channel["sampler"] = len(samplers) - 1


class _Changed:
    """A file's content with arrays added to its binary chunk."""

    def __init__(self, glb: Glb) -> None:
        self.content = glb.content
        self.parts = [glb.binary, bytes(-len(glb.binary) % 4)]
        self.length = len(glb.binary) + len(self.parts[1])
        if not glb.entries("buffers"):
            self.content["buffers"] = [{"byteLength": 0}]
        for kind in ("bufferViews", "accessors"):
            self.content[kind] = glb.entries(kind)

    def add(self, array: npt.NDArray[np.float32], form: str, *, bounds: bool = False) -> int:
        """Append an array and return its accessor's number."""
        data = np.ascontiguousarray(array, "<f4").tobytes()
        self.content["bufferViews"].append({"buffer": 0, "byteOffset": self.length, "byteLength": len(data)})
        accessor: dict[str, Any] = {
            "bufferView": len(self.content["bufferViews"]) - 1,
            "componentType": FLOAT,
            "count": len(array),
            "type": form,
        }
        if bounds:
            columns = array.reshape(len(array), -1)
            accessor |= {"min": columns.min(0).tolist(), "max": columns.max(0).tolist()}
        self.content["accessors"].append(accessor)
        self.parts.append(data)
        self.length += len(data)
        return len(self.content["accessors"]) - 1

    def write(self, path: Path) -> None:
        """Write header, description and binary chunk.

        Raises:
            FaceDiffError: if the file would be larger than its header can count.
        """
        self.content["buffers"][0]["byteLength"] = self.length
        text = json.dumps(self.content, separators=(",", ":"), allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        length = 12 + 8 + len(text) + 8 + self.length
        if length > LIMIT:
            raise FaceDiffError(f"{path}: would be larger than a .glb may be; add a shorter animation")
        with atomic(path) as temporary, temporary.open("wb") as stream:
            stream.write(struct.pack("<4sII", b"glTF", 2, length))
            stream.write(struct.pack("<I4s", len(text), b"JSON") + text)
            stream.write(struct.pack("<I4s", self.length, b"BIN\0"))
            stream.writelines(self.parts)
