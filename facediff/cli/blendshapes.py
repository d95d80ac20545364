"""``facediff blendshapes``: animations as weights of blendshapes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import SourceOptions, Tracks
from facediff.cli.options import Picture, check_picture_path, check_source
from facediff.cli.parsing import refuse_idle
from facediff.cli.process import tell
from facediff.errors import FaceDiffError, counted
from facediff.utils import ranges
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.editing.blendshapes import Weights


def blendshapes(
    animation: Annotated[Path | None, Option(metavar="ANIMATION", reads=True)] = None,
    *,
    output: Annotated[Path | None, Option(also="-o", metavar="CSV", writes="file")] = None,
    shapes: Annotated[Path | None, Option(metavar="SHAPES", reads=True)] = None,
    carry: bool = False,
    smoothness: Annotated[ranges.Strength, Option(metavar="S")] = 0.02,
    symmetry: Annotated[ranges.Strength, Option(metavar="S")] = 0.0,
    sparsity: Annotated[ranges.Strength, Option(metavar="S")] = 0.003,
    bounds: Annotated[tuple[ranges.Bound, ranges.Bound], Option(metavar=("LO", "HI"))] = (0.0, 1.0),
    region: Annotated[str | None, Option(metavar="NAME")] = None,
    only_arkit: bool = False,
    plain: bool = False,
    tracks: Tracks = "arkit",
    residual_limit: Annotated[ranges.Strength, Option(metavar="SHARE")] = 0.8,
    key_tolerance: Annotated[ranges.KeyTolerance, Option(metavar="W")] = 0.0,
    csv_rate: Annotated[ranges.FrameRate | None, Option(metavar="F")] = None,
    show: Picture = None,
    write_puppet_shapes: Annotated[Path | None, Option(metavar="DIR", writes="folder")] = None,
    source: SourceOptions,
) -> None:
    """Solve for the weights of blendshapes (ARKit's 52 names) that come nearest to an animation.

    They are written as the table that Live Link Face records; what the table cannot say is in a .json next to it.

    Args:
        animation: motion: .npz of `facediff animate`, .npy, or ARKit's weights (.csv of Live Link Face, .json)
        output: table to write
        shapes: folder of .obj or .ply files named jawOpen, mouthFunnel … with the face at rest as neutral, or a .glb
            with named targets, or "puppet" for those of the built-in face
        carry: the shapes are of another topology: transfer them to the animation's mesh
        smoothness: cost of change over time; 0 is off
        symmetry: cost of a difference between left and right; 0 is off
        sparsity: cost of weights, which keeps shapes at 0 that would cancel one another; 0 is off
        bounds: limits of weights (default: 0 1)
        region: look at a region of the face only, such as lips
        only_arkit: leave out shapes whose names are not ARKit's (for the table of Live Link they always are)
        tracks: oculus (15 visemes) or vrm (vowels and blinks) in place of the shapes' own weights, as a plain table
        plain: columns time, the set's own names, residuals in mm
        residual_limit: share of the motion that weights may leave before they are refused
        key_tolerance: the .json gets the keys of each curve that a straight line does not replace to within so much
        csv_rate: rows a second, interpolated between the frames (default: a row for each frame)
        show: picture of the frame that the shapes fit worst
        write_puppet_shapes: write shapes of the built-in puppet's face (of the speaker --identity) and do nothing else
        source: what completes a bare .npy.
    """
    if write_puppet_shapes is not None:
        if animation is not None:
            raise FaceDiffError("--write-puppet-shapes: writes shapes and solves for none; omit the animation")
        asked = {"output": output, "shapes": shapes, "region": region, "csv_rate": csv_rate, "show": show}
        others = {name: True for name in source.changed() if name != "identity"}
        switches = {"carry": carry, "only_arkit": only_arkit, "plain": plain}
        refuse_idle(
            "has no effect with --write-puppet-shapes",
            **{name: value is not None for name, value in asked.items()},
            **switches,
            **others,
        )
        from facediff.synthetic.known_faces import write_puppet_shapes as write

        written = write(write_puppet_shapes, source.identity)
        tell(f"{write_puppet_shapes}: neutral face and {len(written)} shapes: {', '.join(sorted(written))}")
        return
    for option, value in (("ANIMATION", animation), ("-o", output), ("--shapes", shapes)):
        if value is None:
            raise FaceDiffError(
                f"{option}: is missing; `facediff blendshapes speech.npz -o weights.csv --shapes DIR`; the built-in "
                f"face's shapes are called puppet"
            )
    assert animation is not None and output is not None and shapes is not None  # noqa: S101, PT018 - for type checkers
    check_source(source, [animation])
    if output.suffix.lower() != ".csv":
        raise FaceDiffError(f'--output {output}: unknown suffix "{output.suffix}"; expected a table .csv')
    check_picture_path(show)

    from facediff.editing.blendshapes import SolveOptions
    from facediff.export.writing import check_free
    from facediff.pipelines.motion import SourceReader, solve_weights
    from facediff.utils.files import check_writable

    check_writable(output.with_suffix(".json"))
    check_free(output.with_suffix(".json"))
    lower, upper = bounds
    options = SolveOptions(
        smoothness=smoothness,
        symmetry=symmetry,
        sparsity=sparsity,
        lower=lower,
        upper=upper,
        region=region,
        residual_limit=residual_limit,
    )
    own = SourceReader(source).read(animation)
    if show is not None:
        _ = own.triangles  # refuses an animation without triangles before anything is written
    # Shapes without a column would take motion that the table then lacks, such as mouthOpen that of jawOpen.
    found, weights = solve_weights(own, shapes, options, carry=carry, only_arkit=only_arkit or not plain)
    table = weights if csv_rate is None else weights.at_rate(csv_rate)
    if tracks != "arkit":
        table, plain = table.tracks(tracks), True
    table.save(output, plain=plain, key_tolerance=key_tolerance)
    if show is not None:
        from facediff.export.pictures import draw_worst_frame

        draw_worst_frame(show, own, found, weights)
    tell(f"{output}: {counted(len(weights.values), 'frame')}, {counted(len(weights.names), 'shape')}")
    tell(*found.notes, *remarks(weights, plain=plain))


def remarks(weights: Weights, *, plain: bool) -> list[str]:
    """What a user should know of the weights, a sentence each."""
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
        lines.append(f"not in this table, whose columns are ARKit's; use --plain: {', '.join(weights.extra)}")
    return lines
