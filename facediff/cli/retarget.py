"""``facediff retarget``: animations carried over to another mesh."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.cli.options import add_animation_options, animation_of
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.editing.correspondence import Correspondence


TURNED = 0.7
"""A cosine below this between both meshes' up axes is said."""


def parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff retarget",
        description="Carry an animation over to another mesh. The suffix of OUT chooses the format, as in `facediff "
        "export`.",
    )
    made.add_argument("take", type=Path, metavar="TAKE", help="motion: .npz of `facediff animate`, or .npy")
    made.add_argument(
        "--target-mesh", type=Path, required=True, metavar="FILE", help="the other face at rest: .obj, .ply, .glb …"
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="file to write")
    made.add_argument(
        "--correspondence", type=Path, metavar="MAP", help=".npz to use if it is there, else to write for other takes"
    )
    made.add_argument(
        "--landmarks",
        type=Path,
        metavar="CSV",
        help="pairs of vertices that are one place, `source,target` a line, counted from 0: for meshes that show other "
        "parts of the head",
    )
    made.add_argument("--show", type=Path, metavar="PNG", help="picture of both faces at the most open mouth")
    add_animation_options(made)
    return made


def run(name: str, arguments: Sequence[str]) -> int:
    """Carry, show and write; every input is checked first."""
    args = parser().parse_args(list(arguments))

    from facediff.cli.data import check_picture_path
    from facediff.cli.options import carried_with
    from facediff.export import ExportOptions, check_export, write_animations

    if args.output.suffix == ".csv":
        raise FaceDiffError(
            f"--output {args.output}: weights need shapes; write .npz, and then use `facediff blendshapes`"
        )
    check_export(args.output, ExportOptions())
    check_picture_path(args.show)
    animation = animation_of(args.animation, args)
    made, found = carried_with(animation, args.target_mesh, args.correspondence, args.landmarks)
    written = write_animations(args.output, [made], ExportOptions())
    if args.show is not None:
        show(args.show, animation, made, found)
        written.append(args.show)
    for file in written:
        print(file)
    for line in told(animation, made, found):
        print(line)
    return 0


def told(animation: Animation, made: Animation, found: Correspondence) -> list[str]:
    """What a user should know of a correspondence, a sentence each."""
    import numpy as np

    from facediff.animation import metres_per_unit

    millimetres = 1000 * metres_per_unit(made.unit)
    still, unsure = np.count_nonzero(found.share == 0), np.count_nonzero(found.trust < 0.5)
    lines = [
        f"{len(animation.template)} vertices to {len(made.template)}: the meshes lie "
        f"{np.median(found.distances) * millimetres:.2g} mm apart (median), scale "
        f"{found.similarity.scale:.4g}, unit {made.unit}",
        f"{unsure} vertices lie where the source has no like surface and follow their neighbours; {still} lie far from "
        f"it and stand still",
    ]
    if found.fits_badly:
        lines.append("the meshes fit badly: look at the result with --show, and give --landmarks")
    if found.similarity.rotation[1, 1] < TURNED:
        lines.append("the target mesh is turned against the take, whose y axis points up: mind it in what is written")
    return lines


def show(path: Path, animation: Animation, made: Animation, found: Correspondence) -> None:
    """Draw the source, the target, how far each vertex of it moves, and how far the meshes lie apart."""
    import numpy as np

    from facediff.animation import metres_per_unit
    from facediff.cli.data import Panel, heat, widest_frame, write_panels

    frame, millimetres = widest_frame(animation), 1000 * metres_per_unit(made.unit)
    # In the source's axes and unit, so that one camera shows both.
    back = found.similarity.inverse()
    posed = back.apply(made.vertices[frame])
    moved, moves = heat(np.linalg.norm(made.vertices[frame] - made.template, axis=1) * millimetres, "carried motion")
    apart, distances = heat(found.distances * millimetres, "distance of the meshes")
    write_panels(
        path,
        [
            Panel(
                f"{animation.name}, frame {frame}",
                np.asarray(animation.vertices[frame]),
                animation.triangles,
                animation.colours,
            ),
            Panel("carried over", posed, made.triangles, made.colours),
            Panel(moved, posed, made.triangles, moves),
            Panel(apart, back.apply(made.template), made.triangles, distances),
        ],
    )
