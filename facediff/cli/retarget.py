"""``facediff retarget``: animations transferred to another mesh."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from facediff.animation.options import SourceOptions
from facediff.cli.options import Map, Output, PageServer, Picture, check_source
from facediff.cli.parsing import changed
from facediff.cli.process import tell
from facediff.errors import FaceDiffError, refuse_idle
from facediff.utils.files import check_writable
from facediff.utils.option import Option

if TYPE_CHECKING:
    from facediff.animation import Animation
    from facediff.editing.correspondence import Correspondence
    from facediff.editing.fit_check import FitReport

TURNED = 0.7
"""A cosine below this between both meshes' up axes is reported."""


@dataclass(frozen=True)
class TransferOptions:
    """Transfer.

    Attributes:
        correspondence: .npz to use if it exists, else to write for other animations
        landmarks: corresponding points: .csv with a pair of vertices a line, counted from 0, or a name for a vertex,
            such as `nose_tip,4034`; or the .json that was picked
        part: names of the parts that show the face, by node, mesh, group or material; `*` stands for any letters
            (default: it is searched for in all parts). Teeth and tongue follow the jaw, other parts stand still
        pick: pick landmarks on a page in the browser first; they are saved next to the correspondence, or to OUT, as
            <name>.landmarks.json, and the command goes on with them
        show: picture of both faces at the widest mouth, a full blink and raised brows
        accept_poor: write the animation even if its lips, its folds or its coverage are wrong
        add_to_mesh: write the target .glb itself with the animation added; UVs, materials, skins and targets stay
            (default for a .glb from a .glb that has materials, skins or targets)
        bare_face: write the animated surface alone, without the other parts of the target .glb
        carry: move the surface of a target .glb that has shapes of its own (ARKit's, VRM's or Oculus' names), which
            else play the motion by their names, with its bones for head, eyes and jaw
        quiet: print the files and warnings alone
    """

    correspondence: Map = None
    landmarks: Annotated[Path | None, Option(metavar="FILE", reads=True, exists="file")] = None
    part: Annotated[list[str] | None, Option(metavar="NAME", many=True)] = None
    pick: bool = False
    show: Picture = None
    accept_poor: bool = False
    add_to_mesh: Annotated[bool, Option(without="bare_face")] = False
    bare_face: bool = False
    carry: Annotated[bool, Option(without="add_to_mesh bare_face")] = False
    quiet: bool = False


def retarget(
    animation: Annotated[Path, Option(metavar="ANIMATION", reads=True, exists="file")],
    *,
    target_mesh: Annotated[Path, Option(metavar="FILE", reads=True, exists="file")],
    output: Output,
    transfer: TransferOptions,
    page: PageServer,
    source: SourceOptions,
) -> None:
    """Transfer an animation to another mesh. The suffix of OUT chooses the format, as in `facediff export`.

    Args:
        animation: motion: .npz of `facediff animate`, .npy, or ARKit's weights (.csv of Live Link Face, .json)
        target_mesh: the other face at rest: .obj, .ply, .glb …
        output: file to write
        transfer: how the motion is mapped to the mesh.
        page: where landmarks are picked.
        source: mesh, frame rate and unit of a bare .npy.
    """
    if output.suffix == ".csv":
        raise FaceDiffError(f"--output {output}: weights need shapes; write .npz, and then use `facediff blendshapes`")
    both_glb = target_mesh.suffix.lower() == output.suffix.lower() == ".glb" and output != target_mesh
    if transfer.add_to_mesh and not both_glb:
        raise FaceDiffError(f"--add-to-mesh: expected two different .glb, not {target_mesh} and {output}; name them so")
    check_source(source)
    if transfer.pick:
        picked = landmarks_path(transfer.correspondence or output)
        check_pick(picked, transfer.landmarks, transfer.correspondence)
    else:
        refuse_idle("is for --pick", **changed(page))

    from facediff.editing.blendshapes import has_arkit_weights
    from facediff.export import ExportOptions, check_export, write_animations
    from facediff.export.glb_own_shapes import shapes_to_drive
    from facediff.mesh.glb import has_materials_or_targets
    from facediff.pipelines.motion import SourceReader

    check_export(output, ExportOptions())
    dressed = transfer.add_to_mesh or (
        not transfer.bare_face and output.suffix.lower() == ".glb" and has_materials_or_targets(target_mesh)
    )
    carries = transfer.carry or transfer.add_to_mesh or transfer.bare_face
    avatar = None if carries else shapes_to_drive(target_mesh, output)
    motion = SourceReader(source).read(animation)
    driven = None if avatar is None else [avatar.summary, *avatar.left_out(motion)]
    if driven is not None and has_arkit_weights(motion):
        idle = {name: is_set for name, is_set in changed(transfer).items() if name != "quiet"}
        refuse_idle(f"has no effect without {{carry}}, since {target_mesh.name} has shapes of its own", **idle)
        written = write_animations(output, [motion], ExportOptions(), into=target_mesh, own_shapes=True)
        tell(*written, *([] if transfer.quiet else driven))
        return
    if transfer.pick:
        pick_on_page(motion, target_mesh, transfer, picked, page)
        transfer = replace(transfer, landmarks=picked)
    write_transferred(motion, target_mesh, output, transfer, dressed=dressed, driven=driven)


def write_transferred(
    motion: Animation, target: Path, output: Path, options: TransferOptions, *, dressed: bool, driven: list[str] | None
) -> None:
    """Transfer a motion by the surface, write it, and report how well it fits."""
    from facediff.editing.fit_check import refuse_poor
    from facediff.editing.retargeting import has_z_up, retarget
    from facediff.export import ExportOptions, write_animations
    from facediff.export.pictures import draw_correspondence
    from facediff.mesh.textures import hands_on_textures

    reports = []

    def judge(transferred: Animation, fit: Correspondence, report: FitReport) -> None:
        reports.append(report)
        if options.show is not None:  # the picture shows the fault
            draw_correspondence(options.show, motion, with_pictures(transferred, target), fit)
        if not options.accept_poor:
            refuse_poor(target, reports[-1])

    transferred, fit = retarget(
        motion,
        target,
        options.correspondence,
        options.landmarks,
        parts=options.part or (),
        check=judge,
        whole_head=driven is not None,
    )
    notes = ["the named landmarks of both topologies hold the correspondence"] if len(reports) > 1 else []
    if len(fit.hidden) and not options.part:
        notes = ["the face was found in one of its parts by itself"]
    if driven is not None:
        notes += driven
    elif dressed and not options.add_to_mesh:
        notes.append(f"in a copy of {target.name} with its materials, skins and targets; --bare-face omits them")
    notes += surface_notes(target, output, transferred)
    into = target if dressed or hands_on_textures(target, output) else None
    written = write_animations(
        output, [transferred], ExportOptions(), into=into, own_shapes=driven is not None, z_up=has_z_up(fit)
    )
    written += [] if options.show is None else [options.show]
    lines = [*remarks(motion, transferred, fit, reports[-1]), *axes_notes(fit, output, dressed), *notes]
    tell(*written, *(line for line in lines if not options.quiet or line.startswith("WARNING")))


def with_pictures(animation: Animation, mesh: Path) -> Animation:
    """An animation in the colours of its mesh's pictures, if it has some."""
    from facediff.mesh.textures import has_textures, read_textures

    if not has_textures(mesh):
        return animation
    textures = read_textures(mesh, len(animation.triangles))
    if all(material.picture is None for material in textures.materials):
        return animation
    return replace(animation, colours=textures.at_vertices(animation.triangles, len(animation.template)))


PICKED = ".landmarks.json"


def landmarks_path(output: Path) -> Path:
    """The file of picked landmarks, next to a correspondence or an animation.

    Example:
        >>> landmarks_path(Path("out/map.npz")).as_posix()
        'out/map.landmarks.json'
    """
    return output.with_name(output.stem + PICKED)


def check_pick(picked: Path, landmarks: Path | None, correspondence: Path | None) -> None:
    """Refuse, before the page is shown, files that would make picking useless."""
    problem = ""
    if correspondence is not None and correspondence.exists():
        problem = f"--pick: {correspondence} exists and would be used without landmarks; remove it, or omit --pick"
    if landmarks is not None and picked.exists() and landmarks.samefile(picked):
        problem = f"--landmarks {landmarks}: --pick continues from this file and overwrites it; omit the option"
    if problem:
        raise FaceDiffError(problem)
    check_writable(picked)


def pick_on_page(animation: Animation, target: Path, options: TransferOptions, picked: Path, page: PageServer) -> None:
    """Serve the page on which landmarks are picked, until they are saved."""
    from facediff.export.viewer.picking import pick_landmarks
    from facediff.mesh import read_mesh
    from facediff.mesh.parts import mesh_parts, named_triangles

    saved = pick_landmarks(
        animation,
        read_mesh(target),
        picked,
        names=(animation.name, target.name),
        start=options.landmarks,
        face_triangles=named_triangles(target, options.part) if options.part else None,
        parts=mesh_parts(target),
        host=page.host,
        port=page.port or 0,
        announce=page.announce("shows both faces: pick corresponding points and save; Ctrl-C ends the command", "pick"),
    )
    if not saved:
        raise FaceDiffError("--pick: no landmarks were saved; save them on the page, or omit --pick")
    tell(picked)


def surface_notes(mesh: Path, output: Path, animation: Animation) -> list[str]:
    """Texture coordinates and materials of a mesh that a file does not get, a sentence each."""
    from facediff.export import FORMATS
    from facediff.mesh.glb import open_glb
    from facediff.mesh.textures import has_textures, read_textures

    is_glb = mesh.suffix.lower() == ".glb"
    if is_glb and output.suffix.lower() in (".glb", ".npy"):
        return []
    textured = has_textures(mesh)
    if textured and "surface" in FORMATS[output.suffix].uses:
        losses = list(read_textures(mesh, len(animation.triangles)).losses)
        is_usd = output.suffix.lower() != ".glb"
        return [*losses, *([f"materials and pictures of {mesh.name} are left out; write .glb to keep them"] * is_usd)]
    if is_glb:
        glb = open_glb(mesh)
        if not glb.entries("materials"):
            return []
        parts = "materials, pictures and parts" if glb.entries("images") else "materials and parts"
        colours = "" if animation.colours is None else "the colours of materials are kept as vertex colours, and "
        return [f"of {mesh.name}, {colours}{parts} are left out; write .glb to keep them"]
    if not textured:
        return []
    return [
        f"{output.suffix} has no texture coordinates: those of {mesh.name} are left out; write .glb or "
        f".usdc, or give it to `facediff export` as --surface"
    ]


def remarks(animation: Animation, transferred: Animation, fit: Correspondence, report: FitReport) -> list[str]:
    """Size, distance and quality of a transfer, a sentence each."""
    import numpy as np

    from facediff.animation import metres_per_unit

    millimetres = 1000 * metres_per_unit(transferred.unit)
    still, unsure = np.count_nonzero(fit.share == 0), np.count_nonzero(fit.trust < 0.5)
    lines = [
        f"{len(animation.template)} vertices to {len(transferred.template)}: the meshes lie "
        f"{np.median(fit.distances) * millimetres:.2g} mm apart (median), scale "
        f"{fit.similarity.scale:.4g}, unit {transferred.unit}",
        f"{unsure} vertices lie where the source has no similar surface and follow their neighbours; {still} lie far "
        f"from it and stand still",
    ]
    lines.append(report.summary)
    lines += [f"WARNING: {fault}" for fault in report.faults]
    lines += [f"note: {remark}" for remark in report.remarks]
    return lines


def axes_notes(fit: Correspondence, output: Path, copied: bool) -> list[str]:
    """The up axes of the target mesh and of the written file, which is a copy of the mesh's own if ``copied``."""
    from facediff.editing.retargeting import has_z_up
    from facediff.export import FORMATS

    if has_z_up(fit) and not copied:
        form = FORMATS.get(output.suffix)
        if form is not None and "z" in form.up_axes:
            return ["the target mesh has z up, and so has the written file"]
        return ["the target mesh has z up and is turned: the written file has y up"]
    if fit.similarity.rotation[1, 1] < TURNED:
        return ["the target mesh is turned against the animation, which has y up; so is the written file"]
    return []
