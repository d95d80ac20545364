"""A Wavefront .obj file for every frame; and the mesh at rest that goes with a point cache."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.export.format import ExportOptions, Format, Space, write_folder


def write(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Write one take as a folder of .obj files."""
    (animation,) = takes
    faces, space = face_lines(animation), Space.of(animation, options)
    write_folder(
        path,
        animation,
        space,
        sound,
        lambda points: obj_text(points, animation.colours, faces, comment(animation, space)),
    )


def rest_mesh(animation: Animation, space: Space) -> bytes:
    """The neutral face, with every vertex in its place."""
    return obj_text(
        space.place(animation.template), animation.colours, face_lines(animation), comment(animation, space)
    )


def comment(animation: Animation, space: Space) -> str:
    """One line that says who wrote the file, and in what space."""
    name = " ".join(animation.name.split())
    unit = " ".join(space.unit.split())
    return (
        f"# facediff: {name}, unit {unit} ({space.metres:g} m), {space.up} up, {animation.frame_rate:g} frames a second"
    )


def face_lines(animation: Animation) -> bytes:
    """The triangles, counted from 1, in the order and the winding of the take."""
    return "".join(f"f {a} {b} {c}\n" for a, b, c in (animation.triangles + 1).tolist()).encode()


def obj_text(
    points: npt.NDArray[np.float32], colours: npt.NDArray[np.uint8] | None, faces: bytes, comment: str
) -> bytes:
    """One file. Nine digits give back every float32; colours follow the coordinates as sRGB within 0 and 1."""
    if colours is None:
        rows = "v %.9g %.9g %.9g\n" * len(points) % tuple(points.ravel().tolist())
    else:
        table = np.concatenate([points.astype(np.float64), colours / 255], axis=1)
        rows = "v %.9g %.9g %.9g %.4f %.4f %.4f\n" * len(points) % tuple(table.ravel().tolist())
    return f"{comment}\n{rows}".encode() + faces


FORMAT = Format(
    help="a folder with an .obj mesh for every frame",
    write=write,
    then="any program reads the frames; sequence.json in the folder says the frame rate",
    sound_beside=True,
    folder=True,
)
