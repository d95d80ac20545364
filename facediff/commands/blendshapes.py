"""``facediff blendshapes``: animations as weights of blendshapes."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.commands.take_options import add_take_options, take_of
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.blendshapes import ShapeSet, Weights
    from facediff.takes import Take


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff blendshapes",
        description="Solve for the weights of blendshapes (ARKit's 52 names) that come nearest to an animation, and "
        "write them as the table that Live Link Face records; what the table cannot say is in a .json beside it.",
    )
    made.add_argument("take", type=Path, nargs="?", metavar="TAKE", help="motion: .npz of `facediff animate`, or .npy")
    made.add_argument("-o", "--output", type=Path, metavar="CSV", help="table to write")
    made.add_argument(
        "--shapes",
        type=Path,
        metavar="SHAPES",
        help="folder of .obj or .ply files named jawOpen, mouthFunnel … with the face at rest as neutral, or a .glb "
        "with named targets",
    )
    made.add_argument(
        "--carry", action="store_true", help="the shapes are of another topology: carry them over to the take's mesh"
    )
    made.add_argument(
        "--smoothness", type=float, metavar="S", help="cost of change over time (default: 0.02, 0 is off)"
    )
    made.add_argument(
        "--symmetry", type=float, metavar="S", help="cost of a difference between left and right (default: 0, off)"
    )
    made.add_argument("--bounds", type=float, nargs=2, metavar=("LO", "HI"), help="limits of weights (default: 0 1)")
    made.add_argument("--region", metavar="NAME", help="look at a region of the take only, such as lips")
    made.add_argument("--only-arkit", action="store_true", help="leave out shapes whose names are not ARKit's")
    made.add_argument("--plain", action="store_true", help="columns time, the set's own names, residuals in mm")
    made.add_argument("--show", type=Path, metavar="PNG", help="picture of the frame that the shapes hold worst")
    made.add_argument(
        "--write-puppet-shapes",
        type=Path,
        metavar="DIR",
        help="write shapes of the built-in puppet's face (of the speaker --identity) and do nothing else",
    )
    add_take_options(made)
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Solve and write, or write the puppet's shapes."""
    args = parser().parse_args(list(arguments))
    if args.write_puppet_shapes is not None:
        from facediff.commands.puppet_shapes import write_puppet_shapes

        if args.take is not None:
            raise FaceDiffError("--write-puppet-shapes: writes shapes and solves for none; leave the take away")
        written = write_puppet_shapes(args.write_puppet_shapes, args.identity)
        print(f"{args.write_puppet_shapes}: neutral face and {len(written)} shapes: {', '.join(sorted(written))}")
        return 0
    for option, value in (("TAKE", args.take), ("-o", args.output), ("--shapes", args.shapes)):
        if value is None:
            raise FaceDiffError(f"{option}: is missing; `facediff blendshapes take.npz -o weights.csv --shapes FOLDER`")
    return solved(args)


def solved(args: argparse.Namespace) -> int:
    """Solve for weights and write them."""
    from facediff.blendshapes import ARKIT, SolveOptions, solve, write_live_link, write_weights
    from facediff.commands.check_picture import check_picture_path
    from facediff.export.place import check_free
    from facediff.files import check_writable

    if args.output.suffix.lower() != ".csv":
        raise FaceDiffError(f'--output {args.output}: unknown suffix "{args.output.suffix}"; expected a table .csv')
    for path in (args.output, args.output.with_suffix(".json")):
        check_writable(path)
    check_free(args.output.with_suffix(".json"))
    check_picture_path(args.show)
    lower, upper = args.bounds or (0.0, 1.0)
    usual = SolveOptions()
    options = SolveOptions(
        smoothness=usual.smoothness if args.smoothness is None else args.smoothness,
        symmetry=usual.symmetry if args.symmetry is None else args.symmetry,
        lower=lower,
        upper=upper,
        region=args.region,
    )
    take = take_of(args.take, args)
    if args.show is not None:
        _ = take.triangles  # refuses before anything is written
    shapes = shapes_for(take, args.shapes, carry=args.carry)
    if args.only_arkit:
        shapes = shapes.only(ARKIT)
    weights = solve(take, shapes, options)
    (write_weights if args.plain else write_live_link)(args.output, weights)
    if args.show is not None:
        show(args.show, take, shapes, weights)
    print(f"{args.output}: {len(weights.values)} frames, {len(weights.names)} shapes")
    for line in (*shapes.notes, *told(weights, plain=args.plain)):
        print(line)
    return 0


def shapes_for(take: Take, path: Path, *, carry: bool) -> ShapeSet:
    """Shapes of the take's topology: as they are, or carried over.

    Raises:
        FaceDiffError: if they cannot be read, or do not fit.
    """
    from dataclasses import replace

    from facediff.blendshapes import fitted, read_shape_files, read_shapes
    from facediff.retarget import carry_displacements, correspond

    if not carry:
        return read_shapes(path, take.template, take.unit)
    files = read_shape_files(path)
    if files.neutral is None or files.faces is None:
        raise FaceDiffError(
            f"{path}: carrying shapes over needs their face at rest with triangles; add it as "
            f"neutral{files.first.suffix}"
        )
    found = correspond(files.neutral, files.faces, take.template, take.triangles)
    deltas = carry_displacements(found, files.shapes - files.neutral)
    note = f"the shapes are carried over from a mesh of {len(files.neutral)} vertices"
    if found.fits_badly:
        note += ", which fits badly: look at the result with --show"
    template = take.template.astype("float64")
    return fitted(
        replace(
            files,
            shapes=template + deltas,
            neutral=template,
            faces=take.faces,
            metric=False,
            notes=(*files.notes, note),
        ),
        take.template,
        take.unit,
    )


def told(weights: Weights, *, plain: bool) -> list[str]:
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


def show(path: Path, take: Take, shapes: ShapeSet, weights: Weights) -> None:
    """Draw the frame with the greatest residual: as it was, as the shapes make it, and what is between them."""
    import numpy as np

    from facediff.commands.check_picture import Panel, heat, write_panels
    from facediff.takes import metres_per_unit

    frame = int(weights.residual_rms_mm.argmax())
    truth = np.asarray(take.vertices[frame], np.float64)
    built = take.template + np.einsum("k,kvc->vc", weights.values[frame], shapes.deltas)
    millimetres = 1000 * metres_per_unit(take.unit)
    label, colours = heat(np.linalg.norm(truth - built, axis=1) * millimetres, "residual")
    write_panels(
        path,
        [
            Panel(f"{take.name}, frame {frame}", truth, take.triangles, take.colours),
            Panel("from the weights", built, take.triangles, take.colours),
            Panel(label, built, take.triangles, colours),
        ],
    )
