"""A picture of an animated .glb, read as any other program would read it.

Run ``python tools/glb_sheet.py hello.glb docs/images/export_glb.png``: pygltflib reads the file, the weights of the
morph targets are interpolated as glTF 2.0 requires and clamped to 0 … 1 as Blender does, and :mod:`facediff.render`
draws the faces at a few times.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from facediff.render import Renderer, contact_sheet, save_image  # noqa: E402
from facediff.utils.colours import to_srgb  # noqa: E402
from tests.fakes.glb_reader import Reader  # noqa: E402


def main() -> None:
    """Read, interpolate and draw."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("glb", type=Path)
    parser.add_argument("png", type=Path)
    parser.add_argument("--times", type=float, nargs="+", default=[0.0, 0.4, 0.8, 1.2, 1.6, 2.0], help="seconds")
    parser.add_argument("--size", type=int, default=200, help="pixels of a picture")
    args = parser.parse_args()

    glb = Reader(args.glb)
    colours = glb.primitive.attributes.COLOR_0
    renderer = Renderer(
        glb.values(glb.primitive.indices).reshape(-1, 3).astype(np.int32),
        template=glb.values(glb.primitive.attributes.POSITION),
        size=args.size,
        colours=None if colours is None else to_srgb(glb.values(colours)),
    )
    pictures = [renderer.render(glb.at(time)) for time in args.times]
    save_image(args.png, contact_sheet(pictures, 6, labels=[f"{time:.2f} s" for time in args.times]))


if __name__ == "__main__":
    main()
