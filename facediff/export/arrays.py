"""Numbers: NumPy's files of vertices or of a whole animation, and files of blendshape weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from facediff.animation import Animation, write_archive
from facediff.animation.options import ExportOptions
from facediff.export.format import FileSpace, Format
from facediff.registry import export_format
from facediff.spaces.arkit import ARKIT
from facediff.utils.arrays import ArrayWriter

if TYPE_CHECKING:
    from facediff.editing.blendshapes import Weights


@export_format.register("npy")
class Vertices(Format):
    """NumPy: absolute vertices (frames, vertices, 3), float32; channels (frames, channels) where there is no face."""

    next_step = "numpy.load gives the vertices; `facediff evaluate` scores them"
    needs_mesh = False

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Write frame by frame."""
        (animation,) = animations
        if animation.without_face and animation.values is not None:
            with ArrayWriter(path, animation.values.shape[1:]) as writer:
                writer.write(animation.values)
            return
        with ArrayWriter(path, animation.template.shape) as writer:
            for frame in FileSpace.of(animation, options).frames(animation):
                writer.write(frame[None])


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
            head, original = animation.head, animation
            animation = replace(
                animation,
                vertices=vertices,
                template=space.place(animation.template),
                unit=space.unit,
                head=None if head is None else head * np.repeat([1.0, space.factor], 3),
            )
            if original.values is not None:
                deltas = None if original.deltas is None else original.deltas * space.factor
                animation = animation.made_of(original.space, original.values, deltas)
        write_archive(path, animation if not options.no_speech else replace(animation, speech=None))


@export_format.register("csv")
class BlendshapeWeights(Format):
    """Weights of blendshapes (ARKit) as Live Link Face writes them; needs --shapes, but for the built-in face."""

    next_step = "Unreal: docs/programs.md; `facediff blendshapes` has more options"
    speech = "next to it"
    needs_mesh = False
    needs_shapes = True
    units = "none"
    up_axes = ()
    uses = ("shapes", "tracks")

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """Solve for the weights and write them, with a .json file that says how well they fit."""
        (animation,) = animations
        weights = _arkit_weights(animation, options)
        if options.tracks != "arkit":
            weights = weights.tracks(options.tracks)
        weights.save(path, plain=options.tracks != "arkit")

    def companions(self, path: Path, animation: Animation) -> list[Path]:
        """The .json file."""
        return [path.with_suffix(".json")]


def _arkit_weights(animation: Animation, options: ExportOptions) -> Weights:
    """The animation's own weights, or weights of the shapes in the options; by default of the built-in shapes."""
    from facediff.editing.blendshapes import SolveOptions, own_weights, solve
    from facediff.editing.shapes import BUILT_IN, read_shapes

    if options.shapes is None and animation.space.kind == "arkit":
        return own_weights(animation)
    # Only ARKit's: others would take motion that the file then lacks
    shapes = read_shapes(Path(options.shapes or BUILT_IN), animation.template, animation.unit).only(ARKIT)
    return solve(animation, shapes, SolveOptions())
