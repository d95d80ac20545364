"""``facediff blendshapes``: animations as weights of blendshapes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import SourceOptions, Tracks
from facediff.cli.options import Picture, check_source
from facediff.cli.parsing import changed
from facediff.cli.process import tell
from facediff.errors import FaceDiffError, counted, refuse_idle
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.editing.blendshapes import Weights


@dataclass(frozen=True)
class WeightOptions:
    """Weights.

    Attributes:
        carry: the shapes are of another topology: transfer them to the animation's mesh
        smoothness: cost of change over time; 0 is off
        symmetry: cost of a difference between left and right; 0 is off
        sparsity: cost of weights, which keeps shapes at 0 that would cancel one another; 0 is off
        bounds: limits of weights (default: 0 1)
        region: look at a region of the face only, such as lips
        only_arkit: leave out shapes with other names than ARKit's (for the table of Live Link they always are)
        residual_limit: share of the motion that weights may leave before they are refused
    """

    carry: bool = False
    smoothness: Annotated[ranges.Strength, Option(metavar="S")] = 0.02
    symmetry: Annotated[ranges.Strength, Option(metavar="S")] = 0.0
    sparsity: Annotated[ranges.Strength, Option(metavar="S")] = 0.003
    bounds: Annotated[tuple[ranges.Bound, ranges.Bound], Option(metavar=("LO", "HI"))] = (0.0, 1.0)
    region: Annotated[str | None, Option(metavar="NAME")] = None
    only_arkit: bool = False
    residual_limit: Annotated[ranges.Strength, Option(metavar="SHARE")] = 0.8


@dataclass(frozen=True)
class TableOptions:
    """Table.

    Attributes:
        plain: columns time, the set's own names, residuals in mm
        tracks: oculus (15 visemes) or vrm (vowels and blinks) in place of the shapes' own weights, as a plain table
        show: picture of the frame that the shapes fit worst
    """

    plain: bool = False
    tracks: Tracks = "arkit"
    show: Picture = None


def blendshapes(
    animation: Annotated[Path | None, Option(metavar="ANIMATION", reads=True, exists="file")] = None,
    *,
    output: Annotated[Path | None, Option(also="-o", metavar="CSV", writes="file", suffixes=(".csv",))] = None,
    shapes: Annotated[Path | None, Option(metavar="SHAPES", reads=True)] = None,
    write_puppet_shapes: Annotated[
        Path | None, Option(metavar="DIR", writes="folder", without="animation output shapes")
    ] = None,
    weights: WeightOptions,
    table: TableOptions,
    source: SourceOptions,
) -> None:
    """Solve for the weights of blendshapes (ARKit's 52 names) that come nearest to an animation.

    They are written as the table that Live Link Face records, with a .json next to it for everything else.

    Args:
        animation: motion: .npz of `facediff animate`, .npy, or ARKit's weights (.csv of Live Link Face, .json)
        output: table to write
        shapes: folder of .obj or .ply files named jawOpen, mouthFunnel … with the face at rest as neutral, or a .glb
            with named targets, or "puppet" for the built-in face's
        write_puppet_shapes: write shapes of the built-in puppet's face (of the speaker --identity) and do nothing else
        weights: how they are solved for.
        table: how they are written.
        source: mesh, frame rate and unit of a bare .npy.
    """
    if write_puppet_shapes is not None:
        idle = {**changed(weights), **changed(table), **changed(source), "identity": False}
        refuse_idle("has no effect with --write-puppet-shapes", **idle)
        from facediff.synthetic.known_faces import write_puppet_shapes as write

        written = write(write_puppet_shapes, source.identity)
        tell(f"{write_puppet_shapes}: neutral face and {len(written)} shapes: {', '.join(sorted(written))}")
        return
    if animation is None or output is None or shapes is None:
        raise FaceDiffError(
            "expected an animation, -o and --shapes: `facediff blendshapes speech.npz -o weights.csv --shapes DIR`; "
            "the built-in face's shapes are called puppet"
        )
    check_source(source)

    from facediff.editing.blendshapes import SolveOptions
    from facediff.export.writing import check_free
    from facediff.pipelines.motion import SourceReader, solve_weights
    from facediff.utils.files import check_writable

    check_writable(output.with_suffix(".json"))
    check_free(output.with_suffix(".json"))
    settings = {name: value for name, value in vars(weights).items() if name not in ("carry", "bounds", "only_arkit")}
    options = SolveOptions(**settings, lower=weights.bounds[0], upper=weights.bounds[1])
    motion = SourceReader(source).read(animation)
    if table.show is not None:
        _ = motion.triangles  # refuses an animation without triangles before anything is written
    plain = table.plain or table.tracks != "arkit"
    # Shapes without a column would take motion that the table then lacks: mouthOpen would take jawOpen's.
    only_arkit = weights.only_arkit or not table.plain
    shape_set, solved = solve_weights(motion, shapes, options, carry=weights.carry, only_arkit=only_arkit)
    rows = solved if table.tracks == "arkit" else solved.tracks(table.tracks)
    rows.save(output, plain=plain)
    if table.show is not None:
        from facediff.export.pictures import draw_worst_frame

        draw_worst_frame(table.show, motion, shape_set, solved)
    tell(f"{output}: {counted(len(solved.values), 'frame')}, {counted(len(solved.names), 'shape')}")
    tell(*shape_set.notes, *remarks(solved, plain=plain))


def remarks(weights: Weights, *, plain: bool) -> list[str]:
    """Residual, convergence and absent shapes, a sentence each."""
    import numpy as np

    share, rms = weights.residual_share, weights.residual_rms_mm
    lines = [
        f"residual: median {np.median(rms):.3g} mm, {np.median(share):.1%} of the motion's "
        f"{weights.amplitude_mm:.3g} mm; worst frame {int(rms.argmax())} with {rms.max():.3g} mm, {share.max():.1%}"
    ]
    if weights.metadata["solve converged"] != "yes":
        lines.append(f"the solve did not converge ({weights.metadata['solve converged']}): look at the residual")
    if weights.absent:
        lines.append(
            f"absent, so that their weights are 0 and say nothing ({len(weights.absent)}): {', '.join(weights.absent)}"
        )
    if weights.extra and not plain:
        lines.append(f"not in this table of ARKit's columns; use --plain: {', '.join(weights.extra)}")
    return lines
