"""A picture of an animated .glb, read as any other program would read it.

Run ``python tools/glb_sheet.py hello.glb docs/images/export_glb.png``: pygltflib reads the file, the weights of the
morph targets are interpolated as glTF 2.0 requires and clamped to 0 … 1 as Blender does, and :mod:`facediff.render`
draws the faces at a few times.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
from numpy.typing import NDArray

from facediff.render import Renderer, contact_sheet, save_image
from facediff.utils.colours import to_srgb

COMPONENTS = {5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3}


def values(gltf: pygltflib.GLTF2, index: int) -> NDArray[Any]:
    """The numbers of an accessor, (N, components)."""
    accessor = gltf.accessors[index]
    view = gltf.bufferViews[accessor.bufferView]
    width = WIDTHS[accessor.type]
    start = view.byteOffset + (accessor.byteOffset or 0)
    flat = np.frombuffer(gltf.binary_blob(), COMPONENTS[accessor.componentType], accessor.count * width, start)
    return flat.reshape(-1, width)


def main() -> None:
    """Read, interpolate and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("glb", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--times", type=float, nargs="+", default=[0.0, 0.4, 0.8, 1.2, 1.6, 2.0], help="seconds")
    parser.add_argument("--size", type=int, default=200, help="pixels of a picture")
    args = parser.parse_args()

    gltf = pygltflib.GLTF2().load(str(args.glb))
    primitive, sampler = gltf.meshes[0].primitives[0], gltf.animations[0].samplers[0]
    times = values(gltf, sampler.input)[:, 0]
    weights = values(gltf, sampler.output).reshape(len(times), -1)
    rest = values(gltf, primitive.attributes.POSITION)
    shapes = np.stack([values(gltf, target["POSITION"]) for target in primitive.targets])
    colours = primitive.attributes.COLOR_0
    renderer = Renderer(
        values(gltf, primitive.indices).reshape(-1, 3).astype(np.int32),
        template=rest,
        size=args.size,
        colours=None if colours is None else to_srgb(values(gltf, colours)),
    )
    pictures = []
    for time in args.times:
        now = np.clip([np.interp(time, times, column) for column in weights.T], 0, 1)
        pictures.append(renderer.render(rest + np.tensordot(now, shapes, axes=1)))
    save_image(args.png, contact_sheet(pictures, 6, labels=[f"{time:.2f} s" for time in args.times]))


if __name__ == "__main__":
    main()
