"""NumPy's own files: bare vertices, or a whole take."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.animation import Animation, write_archive
from facediff.animation.files import MotionWriter
from facediff.export.format import ExportOptions, Format, Space


def write_vertices(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Absolute vertices (T, V, 3), float32; written frame by frame."""
    (animation,) = takes
    writer = MotionWriter(path, animation.template.shape)
    try:
        for frame in Space.of(animation, options).frames(animation):
            writer.write(frame[None])
    finally:
        writer.close()


def write_animation(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """The take with everything it has, in another unit where one is chosen."""
    (animation,) = takes
    space = Space.of(animation, options)
    if options.unit is not None:
        vertices = np.stack(list(space.frames(animation)))
        animation = replace(animation, vertices=vertices, template=space.place(animation.template), unit=space.unit)
    write_archive(path, animation if options.speech else replace(animation, speech=None))


VERTICES = Format(
    help="NumPy: absolute vertices (frames, vertices, 3), float32",
    write=write_vertices,
    then="numpy.load gives the vertices; `facediff evaluate` scores them",
    needs_mesh=False,
)
TAKE = Format(
    help="NumPy: the whole take with mesh, speech, frame rate and unit",
    write=write_animation,
    then="`facediff export`, `view`, `blendshapes` and `retarget` take it without further options",
    holds_sound=True,
    needs_mesh=False,
    ups=("y",),
)
