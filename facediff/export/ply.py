"""A binary .ply file for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.export.format import ExportOptions, Format, Space, write_folder
from facediff.export.obj import comment


def write(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Write one take as a folder of .ply files."""
    (animation,) = takes
    space = Space.of(animation, options)
    corners = np.empty(len(animation.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, animation.triangles
    head, faces = header(animation, comment(animation, space)[2:]), corners.tobytes()
    write_folder(path, animation, space, sound, lambda points: head + vertex_bytes(points, animation.colours) + faces)


def header(animation: Animation, comment: str) -> bytes:
    """The words before the numbers."""
    colours = (
        "" if animation.colours is None else "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    )
    return (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {len(animation.template)}\n"
        f"property float x\nproperty float y\nproperty float z\n{colours}"
        f"element face {len(animation.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    ).encode()


def vertex_bytes(points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8] | None) -> bytes:
    """The vertices with their sRGB colours."""
    if colours is None:
        return np.ascontiguousarray(points, "<f4").tobytes()
    rows = np.empty(len(points), [("position", "<f4", 3), ("colour", "u1", 3)])
    rows["position"], rows["colour"] = points, colours
    return rows.tobytes()


FORMAT = Format(
    help="a folder with a binary .ply mesh for every frame",
    write=write,
    then="any program reads the frames; sequence.json in the folder says the frame rate",
    sound_beside=True,
    folder=True,
)
