"""Numbers: NumPy's files of vertices or of a whole animation, and a table of blendshape weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from facediff.animation import Animation, write_archive
from facediff.animation.files import MotionWriter
from facediff.animation.options import ExportOptions
from facediff.export.format import FileSpace, Format
from facediff.registry import export_format


@export_format.register("npy")
class Vertices(Format):
    """NumPy: absolute vertices (frames, vertices, 3), float32; channels (frames, channels) where there is no face."""

    next_step = "numpy.load gives the vertices; `facediff evaluate` scores them"
    needs_mesh = False

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write frame by frame."""
        (animation,) = animations
        if animation.without_face and animation.values is not None:
            channels = MotionWriter(path, animation.values.shape[1:])
            channels.write(animation.values)
            channels.close()
            return
        writer = MotionWriter(path, animation.template.shape)
        try:
            for frame in FileSpace.of(animation, options).frames(animation):
                writer.write(frame[None])
        finally:
            writer.close()


@export_format.register("npz")
class Archive(Format):
    """NumPy: the whole animation with mesh, speech, frame rate and unit."""

    next_step = "`facediff export`, `view`, `blendshapes` and `retarget` read it without further options"
    speech = "in the file"
    needs_mesh = False
    up_axes = ("y",)

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write everything that the animation has, in another unit where one is chosen."""
        (animation,) = animations
        space = FileSpace.of(animation, options)
        if options.output_unit is not None:
            vertices = np.stack(list(space.frames(animation)))
            head = animation.head
            animation = replace(
                animation,
                vertices=vertices,
                template=space.place(animation.template),
                unit=space.unit,
                head=None if head is None else head * np.repeat([1.0, space.factor], 3),
            )
        write_archive(path, animation if not options.no_speech else replace(animation, speech=None))


@export_format.register("csv")
class BlendshapeWeights(Format):
    """Weights of blendshapes (ARKit) as Live Link Face writes them; needs --shapes, but for motion in such weights."""

    next_step = "Unreal: docs/programs.md; `facediff blendshapes` has more options"
    speech = "next to it"
    needs_mesh = False
    needs_shapes = True
    uses = ("shapes", "tracks", "key_tolerance")
    units = "none"
    up_axes = ()

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Solve for the weights and write them, with a .json file that says how well they fit."""
        from facediff.editing.blendshapes import SolveOptions, own_weights, solve
        from facediff.editing.shapes import read_shapes
        from facediff.spaces.arkit import ARKIT

        (animation,) = animations
        if options.shapes is None:  # checked by check_export
            weights = own_weights(animation)
        else:
            # Only those with a column: others would take motion that the table then lacks
            shapes = read_shapes(Path(options.shapes), animation.template, animation.unit).only(ARKIT)
            weights = solve(animation, shapes, SolveOptions())
        if options.tracks != "arkit":
            weights = weights.tracks(options.tracks)
        weights.save(path, plain=options.tracks != "arkit", key_tolerance=options.key_tolerance)

    def companions(self, path: Path, animation: Animation) -> list[Path]:
        """The .json file."""
        return [path.with_suffix(".json")]
