"""The animated vertices of a whole .glb as the glTF 2.0 specification defines them, with NumPy and nothing of facediff.

Accessors with strides, normalised whole numbers and sparse values (3.6.2), the tree of nodes (3.5), morph targets
(3.7.2.2), skins (3.7.3) and linear samplers (3.11).
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

Array = npt.NDArray[np.float64]
NUMBERS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class GltfScene:
    """A file whose first animation is played."""

    def __init__(self, path: Path) -> None:
        data = path.read_bytes()
        size = int.from_bytes(data[12:16], "little")
        self.content: dict[str, Any] = json.loads(data[20 : 20 + size])
        self.binary = data[28 + size :]

    def _view(self, view: int, offset: int, count: int, kind: str, width: int) -> npt.NDArray[Any]:
        entry = self.content["bufferViews"][view]
        item = np.dtype(kind).itemsize
        stride = entry.get("byteStride", width * item)
        start = entry.get("byteOffset", 0) + offset
        table = np.lib.stride_tricks.as_strided(
            np.frombuffer(self.binary, np.uint8)[start:], (count, width * item), (stride, 1)
        )
        return np.ascontiguousarray(table).view(kind)

    def accessor(self, number: int) -> Array:
        """Values (N, width)."""
        entry = self.content["accessors"][number]
        count, width, kind = entry["count"], WIDTHS[entry["type"]], NUMBERS[entry["componentType"]]
        values = np.zeros((count, width), kind)
        if "bufferView" in entry:
            values = self._view(entry["bufferView"], entry.get("byteOffset", 0), count, kind, width)
        if "sparse" in entry:
            sparse, values = entry["sparse"], values.copy()
            where, what = sparse["indices"], sparse["values"]
            rows = self._view(
                where["bufferView"], where.get("byteOffset", 0), sparse["count"], NUMBERS[where["componentType"]], 1
            )
            values[rows[:, 0]] = self._view(what["bufferView"], what.get("byteOffset", 0), sparse["count"], kind, width)
        if entry.get("normalized"):
            return np.asarray(np.maximum(values / np.iinfo(kind).max, -1.0), np.float64)
        return values.astype(np.float64)

    def _played(self, time: float) -> dict[tuple[int, str], Array]:
        """Values of the first animation by node and path."""
        result = {}
        animation = self.content["animations"][0]
        for channel in animation["channels"]:
            sampler, path = animation["samplers"][channel["sampler"]], channel["target"]["path"]
            assert sampler["interpolation"] == "LINEAR"
            times = self.accessor(sampler["input"])[:, 0]
            rows = self.accessor(sampler["output"]).reshape(len(times), -1)
            at = float(np.clip(time, times[0], times[-1]))
            if path == "rotation":
                value = Slerp(times, Rotation.from_quat(rows))(at).as_quat()
            else:
                value = np.array([np.interp(at, times, column) for column in rows.T])
            result[channel["target"]["node"], path] = value
        return result

    def vertices(self, time: float) -> dict[str, Array]:
        """Vertices (V, 3) of each primitive in the scene, by the name of its material."""
        played, nodes = self._played(time), self.content["nodes"]
        globals_: dict[int, Array] = {}

        def place(node: int, above: Array) -> None:
            entry = nodes[node]
            own = np.eye(4)
            if "matrix" in entry:
                own = np.array(entry["matrix"]).reshape(4, 4).T
            else:
                turn = played.get((node, "rotation"), np.array(entry.get("rotation", [0, 0, 0, 1.0])))
                own[:3, :3] = Rotation.from_quat(turn).as_matrix() * np.array(entry.get("scale", [1, 1, 1.0]))
                own[:3, 3] = entry.get("translation", [0, 0, 0])
            globals_[node] = above @ own
            for child in entry.get("children", []):
                place(child, globals_[node])

        for root in self.content["scenes"][self.content.get("scene", 0)]["nodes"]:
            place(root, np.eye(4))
        result = {}
        for node, matrix in globals_.items():
            if "mesh" not in nodes[node]:
                continue
            mesh = self.content["meshes"][nodes[node]["mesh"]]
            for primitive in mesh["primitives"]:
                points = self.accessor(primitive["attributes"]["POSITION"])
                targets = primitive.get("targets", [])
                weights = played.get((node, "weights"), nodes[node].get("weights", mesh.get("weights", [])))
                for weight, target in zip(weights, targets, strict=bool(targets)):
                    points = points + weight * self.accessor(target["POSITION"])
                name = self.content["materials"][primitive["material"]]["name"]
                result[name] = self._placed(primitive, nodes[node].get("skin"), matrix, globals_, points)
        return result

    def _placed(
        self, primitive: dict[str, Any], skin: int | None, matrix: Array, placed: dict[int, Array], points: Array
    ) -> Array:
        points = np.concatenate([points, np.ones((len(points), 1))], axis=1)
        if skin is None:
            return np.asarray((points @ matrix.T)[:, :3])
        entry = self.content["skins"][skin]
        binds = self.accessor(entry["inverseBindMatrices"]).reshape(-1, 4, 4).transpose(0, 2, 1)
        joints = np.stack([placed[joint] @ bind for joint, bind in zip(entry["joints"], binds, strict=True)])
        slots = self.accessor(primitive["attributes"]["JOINTS_0"]).astype(int)
        weights = self.accessor(primitive["attributes"]["WEIGHTS_0"])
        blended = np.einsum("vk,vkij->vij", weights, joints[slots])
        return np.asarray(np.einsum("vij,vj->vi", blended, points)[:, :3])
