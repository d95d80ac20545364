"""``facediff blendshapes``: animations as weights of blendshapes."""

from __future__ import annotations

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.cli.options import add_animation_options, animation_of
from facediff.errors import FaceDiffError, choices

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    Array = npt.NDArray[np.float64]
    from facediff.animation import Animation
    from facediff.editing.blendshapes import Weights
    from facediff.editing.shapes import ShapeSet


# ARKit-style shapes of the built-in puppet's face, for those who have none of their own.

WHOLE = {
    "jawOpen": "jaw_open",
    "mouthFunnel": "funnel",
    "mouthPucker": "pucker",
    "mouthRollLower": "lower_lip_tuck",
    "mouthShrugLower": "chin_raise",
    "browInnerUp": "inner_brow_up",
    "cheekPuff": "cheek_puff",
}
"""Controls of the rig that are a shape by themselves."""

SIDED = {
    "eyeBlink": "lids_close",
    "eyeSquint": "squint",
    "eyeWide": "lids_wide",
    "mouthSmile": "corner_up",
    "mouthFrown": "corner_down",
    "mouthStretch": "stretch",
    "mouthPress": "lip_press",
    "mouthLowerDown": "lower_lip_drop",
    "mouthUpperUp": "upper_lip_raise",
    "browDown": "brow_frown",
    "browOuterUp": "outer_brow_up",
    "cheekSquint": "cheek_raise",
    "noseSneer": "nose_wrinkle",
}
"""Controls that act on both sides, of which two shapes are made."""

BLEND = 0.005
"""Half the width in metres of the strip about the midline over which a side's share goes from 0 to 1."""


def puppet_shapes(speaker: str | None = None) -> tuple[Array, npt.NDArray[np.int64], dict[str, Array]]:
    """A puppet's face at rest (V, 3) in metres, its triangles, and its shapes by ARKit's names, each (V, 3).

    ``mouthClose`` is what closes the lips when it is added to ``jawOpen``, as ARKit has it.

    Args:
        speaker: a speaker of the built-in corpus; the common face if None.

    Raises:
        FaceDiffError: if there is no such speaker.
    """
    import numpy as np

    from facediff.synthetic.face import Shape, build_face
    from facediff.synthetic.rig import CONTROLS, build_rig
    from facediff.synthetic.speakers import SPEAKERS

    if speaker is not None and speaker not in SPEAKERS:
        raise FaceDiffError(f'--identity: there is no speaker "{speaker}"; {choices(speaker, SPEAKERS)}')
    rig = build_rig(Shape() if speaker is None else SPEAKERS[speaker].shape)
    mesh = build_face()
    poses = rig.pose(np.concatenate([np.zeros((1, len(CONTROLS))), np.eye(len(CONTROLS))]))
    neutral = poses[0]
    moves = dict(zip(CONTROLS, poses[1:] - neutral, strict=True))
    across = np.clip((mesh.vertices[:, 0] / BLEND + 1) / 2, 0, 1)
    left = (across * across * (3 - 2 * across))[:, None]
    shapes = {name: neutral + moves[control] for name, control in WHOLE.items()}
    for name, control in SIDED.items():
        shapes[f"{name}Left"] = neutral + left * moves[control]
        shapes[f"{name}Right"] = neutral + (1 - left) * moves[control]
    both = np.zeros((1, len(CONTROLS)))
    both[0, [CONTROLS.index("jaw_open"), CONTROLS.index("lip_closure")]] = 1.0
    shapes["mouthClose"] = neutral + rig.pose(both)[0] - shapes["jawOpen"]
    return neutral, np.asarray(mesh.faces, np.int64), shapes


def write_puppet_shapes(folder: Path, speaker: str | None = None) -> list[str]:
    """Write the shapes as OBJ files, and the face at rest as ``neutral.obj``; the folder appears whole or not at all.

    Returns:
        The names of the shapes.

    Raises:
        FaceDiffError: if the folder is there already or cannot be written, or there is no such speaker.
    """
    from facediff.utils.files import atomic

    if folder.exists():
        raise FaceDiffError(f"{folder}: is there already; choose a new folder")
    neutral, faces, shapes = puppet_shapes(speaker)
    triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    with atomic(folder) as temporary:
        try:
            temporary.mkdir()
            for name, vertices in {"neutral": neutral, **shapes}.items():
                points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
                (temporary / f"{name}.obj").write_text(points + triangles, encoding="ascii")
        except BaseException:
            shutil.rmtree(temporary, ignore_errors=True)
            raise
    return list(shapes)


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
    add_animation_options(made)
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Solve and write, or write the puppet's shapes."""
    args = parser().parse_args(list(arguments))
    if args.write_puppet_shapes is not None:
        if args.animation is not None:
            raise FaceDiffError("--write-puppet-shapes: writes shapes and solves for none; leave the take away")
        written = write_puppet_shapes(args.write_puppet_shapes, args.identity)
        print(f"{args.write_puppet_shapes}: neutral face and {len(written)} shapes: {', '.join(sorted(written))}")
        return 0
    for option, value in (("TAKE", args.animation), ("-o", args.output), ("--shapes", args.shapes)):
        if value is None:
            raise FaceDiffError(f"{option}: is missing; `facediff blendshapes take.npz -o weights.csv --shapes FOLDER`")
    return solved(args)


def solved(args: argparse.Namespace) -> int:
    """Solve for weights and write them."""
    from facediff.cli.data import check_picture_path
    from facediff.editing.blendshapes import SolveOptions, solve, write_live_link, write_weights
    from facediff.editing.shapes import ARKIT
    from facediff.export.writing import check_free
    from facediff.utils.files import check_writable

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
    animation = animation_of(args.animation, args)
    if args.show is not None:
        _ = animation.triangles  # refuses before anything is written
    shapes = shapes_for(animation, args.shapes, carry=args.carry)
    if args.only_arkit:
        shapes = shapes.only(ARKIT)
    weights = solve(animation, shapes, options)
    (write_weights if args.plain else write_live_link)(args.output, weights)
    if args.show is not None:
        show(args.show, animation, shapes, weights)
    print(f"{args.output}: {len(weights.values)} frames, {len(weights.names)} shapes")
    for line in (*shapes.notes, *told(weights, plain=args.plain)):
        print(line)
    return 0


def shapes_for(animation: Animation, path: Path, *, carry: bool) -> ShapeSet:
    """Shapes of the take's topology: as they are, or carried over.

    Raises:
        FaceDiffError: if they cannot be read, or do not fit.
    """
    from dataclasses import replace

    from facediff.editing.correspondence import correspond
    from facediff.editing.retargeting import carry_displacements
    from facediff.editing.shapes import fitted, read_shape_files, read_shapes

    if not carry:
        return read_shapes(path, animation.template, animation.unit)
    files = read_shape_files(path)
    if files.neutral is None or files.faces is None:
        raise FaceDiffError(
            f"{path}: carrying shapes over needs their face at rest with triangles; add it as "
            f"neutral{files.first.suffix}"
        )
    found = correspond(files.neutral, files.faces, animation.template, animation.triangles)
    deltas = carry_displacements(found, files.shapes - files.neutral)
    note = f"the shapes are carried over from a mesh of {len(files.neutral)} vertices"
    if found.fits_badly:
        note += ", which fits badly: look at the result with --show"
    template = animation.template.astype("float64")
    return fitted(
        replace(
            files,
            shapes=template + deltas,
            neutral=template,
            faces=animation.faces,
            metric=False,
            notes=(*files.notes, note),
        ),
        animation.template,
        animation.unit,
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


def show(path: Path, animation: Animation, shapes: ShapeSet, weights: Weights) -> None:
    """Draw the frame with the greatest residual: as it was, as the shapes make it, and what is between them."""
    import numpy as np

    from facediff.animation import metres_per_unit
    from facediff.cli.data import Panel, heat, write_panels

    frame = int(weights.residual_rms_mm.argmax())
    truth = np.asarray(animation.vertices[frame], np.float64)
    built = animation.template + np.einsum("k,kvc->vc", weights.values[frame], shapes.deltas)
    millimetres = 1000 * metres_per_unit(animation.unit)
    label, colours = heat(np.linalg.norm(truth - built, axis=1) * millimetres, "residual")
    write_panels(
        path,
        [
            Panel(f"{animation.name}, frame {frame}", truth, animation.triangles, animation.colours),
            Panel("from the weights", built, animation.triangles, animation.colours),
            Panel(label, built, animation.triangles, colours),
        ],
    )
