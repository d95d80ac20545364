"""A binary .ply file for every frame."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.export.format import Format, Space
from facediff.export.obj import comment
from facediff.export.options import ExportOptions
from facediff.export.sequence import write_folder
from facediff.takes import Take


def write(path: Path, takes: Sequence[Take], options: ExportOptions, sound: str | None) -> None:
    """Write one take as a folder of .ply files."""
    (take,) = takes
    space = Space.of(take, options)
    corners = np.empty(len(take.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    corners["count"], corners["corners"] = 3, take.triangles
    head, faces = header(take, comment(take, space)[2:]), corners.tobytes()
    write_folder(path, take, space, sound, lambda points: head + vertex_bytes(points, take.colours) + faces)


def header(take: Take, comment: str) -> bytes:
    """The words before the numbers."""
    colours = "" if take.colours is None else "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
    return (
        f"ply\nformat binary_little_endian 1.0\ncomment {comment}\nelement vertex {len(take.template)}\n"
        f"property float x\nproperty float y\nproperty float z\n{colours}"
        f"element face {len(take.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
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
