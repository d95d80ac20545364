"""``facediff retarget``: animations transferred to another mesh."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.cli.options import File, Map, Output, Picture, SourceOptions, check_picture_path
from facediff.cli.parsing import Option
from facediff.cli.process import tell
from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.editing.correspondence import Correspondence
    from facediff.editing.fit_check import FitReport

TURNED = 0.7
"""A cosine below this between both meshes' up axes is reported."""


def retarget(
    animation: Annotated[Path, Option(metavar="ANIMATION", reads=True)],
    *,
    target_mesh: Annotated[Path, Option(metavar="FILE", reads=True)],
    output: Output,
    correspondence: Map = None,
    landmarks: File = None,
    part: Annotated[list[str] | None, Option(metavar="NAME", many=True)] = None,
    show: Picture = None,
    accept_poor: bool = False,
    add_to_mesh: bool = False,
    source: SourceOptions,
) -> None:
    """Transfer an animation to another mesh. The suffix of OUT chooses the format, as in `facediff export`.

    Args:
        animation: motion: .npz of `facediff animate`, or .npy
        target_mesh: the other face at rest: .obj, .ply, .glb …
        output: file to write
        correspondence: .npz to use if it exists, else to write for other animations
        landmarks: places that are the same: .csv with a pair of vertices a line, counted from 0, or a name for a
            vertex, such as `nose_tip,4034`; or the .json that was picked
        part: names of the parts that show the face, by node, mesh, group or material; `*` stands for any letters
            (default: it is searched for in all parts). Teeth and tongue follow the jaw, other parts stand still
        show: picture of both faces at the most open mouth
        accept_poor: write the animation although its lips, its folds or its coverage are found to be wrong
        add_to_mesh: write the target .glb itself with the animation added; UVs, materials, skins and targets stay
        source: what completes a bare .npy.
    """
    if output.suffix == ".csv":
        raise FaceDiffError(f"--output {output}: weights need shapes; write .npz, and then use `facediff blendshapes`")
    if add_to_mesh and (output.suffix != ".glb" or target_mesh.suffix.lower() != ".glb" or output == target_mesh):
        raise FaceDiffError(f"--add-to-mesh: expected two different .glb, not {target_mesh} and {output}; name them so")
    source.check([animation])
    for option, file in (("--target-mesh", target_mesh), ("--landmarks", landmarks)):
        if file is not None and not file.is_file():
            raise FaceDiffError(f"{option} {file}: no such file")
    check_picture_path(show)

    from facediff.editing.fit_check import check_fit, refuse_poor
    from facediff.editing.retargeting import retarget as transfer
    from facediff.export import ExportOptions, check_export, write_animations
    from facediff.export.pictures import draw_correspondence

    check_export(output, ExportOptions())
    own = source.read(animation)
    reports = []

    def judge(made: Animation, found: Correspondence) -> None:
        reports.append(check_fit(own, made, found))
        if show is not None:  # the picture shows what is wrong
            draw_correspondence(show, own, made, found)
        if not accept_poor:
            refuse_poor(target_mesh, reports[-1])

    made, found = transfer(own, target_mesh, correspondence, landmarks, parts=part or (), judge=judge)
    notes = ["the named landmarks of both topologies hold the correspondence"] if len(reports) > 1 else []
    if add_to_mesh:
        from facediff.export.glb_added import add_to_glb

        add_to_glb(output, target_mesh, made, ExportOptions().tolerance_mm)
        written = [output]
    else:
        written = write_animations(output, [made], ExportOptions())
    if show is not None:
        written.append(show)
    tell(*written, *remarks(own, made, found, reports[-1]), *notes)


def remarks(animation: Animation, made: Animation, found: Correspondence, report: FitReport) -> list[str]:
    """What a user should know of a result, a sentence each."""
    import numpy as np

    from facediff.animation import metres_per_unit

    millimetres = 1000 * metres_per_unit(made.unit)
    still, unsure = np.count_nonzero(found.share == 0), np.count_nonzero(found.trust < 0.5)
    lines = [
        f"{len(animation.template)} vertices to {len(made.template)}: the meshes lie "
        f"{np.median(found.distances) * millimetres:.2g} mm apart (median), scale "
        f"{found.similarity.scale:.4g}, unit {made.unit}",
        f"{unsure} vertices lie where the source has no similar surface and follow their neighbours; {still} lie far "
        f"from it and stand still",
    ]
    lines.append(report.summary)
    lines += [f"WARNING: {fault}" for fault in report.faults]
    if found.similarity.rotation[1, 1] < TURNED:
        lines.append("the target mesh is turned against the animation, whose y axis points up; so is what is written")
    return lines
