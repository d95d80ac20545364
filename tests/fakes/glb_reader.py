"""A .glb read back as the glTF 2.0 specification defines its animated vertices, by pygltflib."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pygltflib

COMPONENTS = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


class Reader:
    """Values of accessors, and the animated vertices as the specification defines them."""

    def __init__(self, path: Path) -> None:
        self.gltf = pygltflib.GLTF2().load(str(path))
        self.blob = self.gltf.binary_blob()
        self.primitive = self.gltf.meshes[0].primitives[0]

    def values(self, index: int) -> npt.NDArray[Any]:
        accessor = self.gltf.accessors[index]
        view = self.gltf.bufferViews[accessor.bufferView]
        start = view.byteOffset + (accessor.byteOffset or 0)
        width = WIDTHS[accessor.type]
        flat = np.frombuffer(self.blob, COMPONENTS[accessor.componentType], accessor.count * width, start)
        return flat.reshape(-1, width) if width > 1 else flat

    @property
    def sampler(self) -> pygltflib.AnimationSampler:
        return self.gltf.animations[0].samplers[0]

    @property
    def times(self) -> npt.NDArray[np.float32]:
        return self.values(self.sampler.input)

    @property
    def weights(self) -> npt.NDArray[np.float32]:
        return self.values(self.sampler.output).reshape(len(self.times), -1)

    def at(self, time: float, attribute: str = "POSITION") -> npt.NDArray[np.float64]:
        """The attribute at a time, by the linear sampler of section 3.11 and the morphing of section 3.7.2.2."""
        assert self.sampler.interpolation == "LINEAR"
        after = min(int(np.searchsorted(self.times, time)), len(self.times) - 1)
        before = max(after - 1, 0)
        span = float(self.times[after]) - float(self.times[before])
        share = np.clip((time - float(self.times[before])) / span, 0, 1) if span else 0.0
        weights = (1 - share) * self.weights[before].astype(float) + share * self.weights[after].astype(float)
        weights = np.clip(weights, 0, 1)  # as Blender does
        made = self.values(getattr(self.primitive.attributes, attribute)).astype(float)
        for weight, target in zip(weights, self.primitive.targets, strict=True):
            index = target[attribute] if isinstance(target, dict) else getattr(target, attribute)
            made = made + weight * self.values(index)
        return made


def without_new_animation(new: dict[str, Any], old: dict[str, Any]) -> dict[str, Any]:
    """The new description of a .glb file less the first animation, and the data added to the old one."""
    made = copy.deepcopy(new)
    for kind in ("accessors", "bufferViews"):
        del made[kind][len(old.get(kind, [])) :]
    del made["animations"][0]
    made["buffers"][0]["byteLength"] = old["buffers"][0]["byteLength"]
    return made
