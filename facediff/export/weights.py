"""Weights of blendshapes as a table that Live Link Face's readers take."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from facediff.animation import Animation
from facediff.errors import FaceDiffError
from facediff.export.format import ExportOptions, Format, write_wav


def write(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Solve one take for a set of shapes and write the weights as .csv, the speech beside.

    Raises:
        FaceDiffError: if no set of shapes is given, or it does not fit the take.
    """
    from facediff.editing.blendshapes import SolveOptions, solve, write_live_link
    from facediff.editing.shapes import read_shapes

    (animation,) = takes
    if options.shapes is None:
        raise missing_shapes(path)
    shapes = read_shapes(options.shapes, animation.template, animation.unit)
    write_live_link(path, solve(animation, shapes, SolveOptions()))
    if sound is not None:
        write_wav(path.with_name(sound), animation)


def missing_shapes(path: Path) -> FaceDiffError:
    """What a table of weights cannot do without."""
    return FaceDiffError(
        f"{path}: weights need a set of shapes; give --shapes with a folder of meshes or a .glb with named targets"
    )


FORMAT = Format(
    help="weights of blendshapes (ARKit) as Live Link Face writes them; needs --shapes",
    write=write,
    then="Unreal: docs/tools/unreal.md; `facediff blendshapes` has more options",
    sound_beside=True,
    needs_mesh=False,
    unit="none",
    ups=(),
)
