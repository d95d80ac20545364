"""NumPy's own files: bare vertices, or a whole take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.export.format import Format, Space
from facediff.export.options import ExportOptions
from facediff.takes import Take, write_archive
from facediff.takes.motion_files import MotionWriter


def write_vertices(path: Path, takes: Sequence[Take], options: ExportOptions, sound: str | None) -> None:
    """Absolute vertices (T, V, 3), float32; written frame by frame."""
    (take,) = takes
    writer = MotionWriter(path, take.template.shape)
    try:
        for frame in Space.of(take, options).frames(take):
            writer.write(frame[None])
    finally:
        writer.close()


def write_take(path: Path, takes: Sequence[Take], options: ExportOptions, sound: str | None) -> None:
    """The take with everything it has, in another unit where one is chosen."""
    (take,) = takes
    space = Space.of(take, options)
    if options.unit is not None:
        vertices = np.stack(list(space.frames(take)))
        take = replace(take, vertices=vertices, template=space.place(take.template), unit=space.unit)
    write_archive(path, take if options.speech else replace(take, speech=None))


VERTICES = Format(
    help="NumPy: absolute vertices (frames, vertices, 3), float32",
    write=write_vertices,
    then="numpy.load gives the vertices; `facediff evaluate` scores them",
    needs_mesh=False,
)
TAKE = Format(
    help="NumPy: the whole take with mesh, speech, frame rate and unit",
    write=write_take,
    then="`facediff export`, `view`, `blendshapes` and `retarget` take it without further options",
    holds_sound=True,
    needs_mesh=False,
    ups=("y",),
)
