"""``facediff data``: making, checking and importing corpora."""

from __future__ import annotations

import argparse
import importlib
import inspect
import json
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Literal, get_args, get_origin, get_type_hints

from facediff.errors import FaceDiffError, choices

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.animation import Animation
    from facediff.data.check.layouts import View
    from facediff.data.prepare.runner import Plan, Report
    from facediff.mesh.mesh import Mesh
    from facediff.metrics import Region


# Pictures by which a result is looked at: faces beside one another, and numbers at vertices as colours.


@dataclass(frozen=True)
class Panel:
    """A face to draw.

    Attributes:
        label: what stands above.
        vertices: (V, 3), y up, z to the viewer.
        faces: (F, 3).
        colours: (V, 3) sRGB; None for plain material.
    """

    label: str
    vertices: npt.NDArray[np.floating]
    faces: npt.NDArray[np.integer]
    colours: npt.NDArray[np.uint8] | None = None


def check_picture_path(path: Path | None) -> None:
    """Refuse, before any work is done, a picture that could not be written.

    Raises:
        FaceDiffError: if the suffix is not .png or the folder cannot be written.
    """
    from facediff.utils.files import check_writable

    if path is None:
        return
    if path.suffix != ".png":
        raise FaceDiffError(f'--show {path}: unknown suffix "{path.suffix}"; expected a picture .png')
    check_writable(path)


def write_panels(path: Path, panels: Sequence[Panel], size: int = 272) -> None:
    """Draw faces of one unit beside one another at one scale."""
    from facediff.render import Camera, Renderer, contact_sheet, save_image

    camera = Camera.framing([panel.vertices for panel in panels])
    drawn = [
        Renderer(panel.faces, template=panel.vertices, size=size, camera=camera, colours=panel.colours).render(
            panel.vertices
        )
        for panel in panels
    ]
    save_image(path, contact_sheet(drawn, len(drawn), labels=[panel.label for panel in panels]))


def heat(values_mm: npt.NDArray[np.floating], label: str) -> tuple[str, npt.NDArray[np.uint8]]:
    """A label that tells the scale, and the colours of numbers at vertices (V,) from 0 to their greatest."""
    from facediff.render import heat_colours

    highest = max(float(values_mm.max()), 1e-6)
    return f"{label}, 0 to {highest:.2g} mm", heat_colours(values_mm, highest)


def widest_frame(animation: Animation) -> int:
    """The frame in which the mouth is most open; without known lips, that which is furthest from the neutral face."""
    import numpy as np

    best, found = -1.0, 0
    pairs = animation.inner_lip_pairs
    for index, frame in enumerate(animation.vertices):
        if pairs is not None and len(pairs):
            value = float(np.linalg.norm(frame[pairs[:, 0]] - frame[pairs[:, 1]], axis=1).mean())
        else:
            value = float(np.square(frame - animation.template).sum())
        if value > best:
            best, found = value, index
    return found


# ``facediff data check``: what a folder is, what is there, what is missing and what is wrong in it.


def check_parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data check",
        description="Say what a corpus folder is, what is there, what is missing and what is wrong in it. Nothing is "
        "changed. Exit status: 0 sound (warnings allowed), 1 not sound, 2 wrong usage.",
    )
    made.add_argument("root", type=Path, help="the corpus folder")
    made.add_argument("--corpus", help="what it is: biwi, vocaset, mead3d, puppet, or package.module.Class")
    made.add_argument("--split", help="totals of one way to split the corpus only (3DMEAD: sentence, identity)")
    made.add_argument("--quick", action="store_true", help="read headers only, and compare files by size")
    made.add_argument("--json", action="store_true", help="machine-readable: one object")
    made.add_argument("--workers", type=int, help="processes (default: as many as processors if there is much to read)")
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def check_run(name: str, arguments: Sequence[str]) -> int:
    """Check a folder and print the report.

    Returns:
        0 if it is sound, 1 if not.
    """
    args = check_parser().parse_args(list(arguments))
    from facediff.data.check import check, text

    if args.corpus and "." in args.corpus:
        sys.path.append(os.getcwd())  # a data module of one's own may lie in the working folder
    report = check(
        args.root,
        args.corpus,
        split=args.split,
        quick=args.quick,
        workers=args.workers,
        progress=not (args.json or args.quiet),
    )
    if args.json:
        print(json.dumps(report.state(), indent=2))
    else:
        # A file name may hold letters that the terminal's encoding has not.
        encoding = sys.stdout.encoding or "utf-8"
        print(text(report).encode(encoding, errors="backslashreplace").decode(encoding))
    return 0 if report.sound else 1


# ``facediff data prepare``: from the raw distribution of a data set to a folder that facediff trains on.

CORPORA = ("biwi", "vocaset", "mead3d")
"""Modules of :mod:`facediff.data.prepare`; each has a ``plan(raw, *, …)`` whose keyword parameters are its options."""
SHOWN = 20
"""Lines of a list on the screen; the whole list is in the manifest."""


def prepare_parser() -> argparse.ArgumentParser:
    """Options of the command: those that all corpora have, and each one's own."""
    made = argparse.ArgumentParser(
        "facediff data prepare",
        description="Write a corpus folder from a data set as its authors distribute it. A run that was stopped is "
        "taken up where it was by the same command.",
    )
    corpora = made.add_subparsers(dest="corpus", required=True, metavar="corpus")
    for name in CORPORA:
        module = importlib.import_module(f"facediff.data.prepare.{name}")
        title = (module.__doc__ or "").partition("\n")[0]
        corpus = corpora.add_parser(name, help=title, description=title)
        corpus.add_argument("raw", type=Path, help="the raw data set, unpacked")
        corpus.add_argument("out", type=Path, help="folder to write: a new one, or one that this command has begun")
        for parameter in own_options(module.plan):
            _add_option(corpus, parameter, get_type_hints(module.plan)[parameter.name], _meanings(module.plan))
        corpus.add_argument("--workers", type=int, help="processes (default: as many as processors)")
        corpus.add_argument("--quiet", action="store_true", help="no progress bars")
    return made


def own_options(plan: Callable[..., Plan]) -> list[inspect.Parameter]:
    """Keyword parameters of a corpus's ``plan``: each is an option of the command line, beside the common ones."""
    found = inspect.signature(plan).parameters.values()
    return [option for option in found if option.kind is option.KEYWORD_ONLY and option.name != "quiet"]


def _meanings(plan: Callable[..., Plan]) -> dict[str, str]:
    """What the docstring says of each parameter."""
    text = inspect.getdoc(plan) or ""
    entries = re.findall(r"^ {4}(\w+): ((?:.+\n)(?: {8}.+\n)*)", text.partition("Args:\n")[2] + "\n", re.MULTILINE)
    return {name: " ".join(meaning.split()).replace("``", "").replace("%", "%%") for name, meaning in entries}


def _add_option(
    parser: argparse.ArgumentParser, parameter: inspect.Parameter, kind: object, meanings: dict[str, str]
) -> None:
    """An option of the parameter's name, type, default and meaning."""
    needed = parameter.default is parameter.empty
    default = None if needed else parameter.default
    told = "" if default is None or isinstance(default, bool) else f" (default: {default})"
    flag, meaning = f"--{parameter.name.replace('_', '-')}", meanings.get(parameter.name, "") + told
    if isinstance(kind, UnionType):
        kind = next(choice for choice in get_args(kind) if choice is not type(None))
    if kind is bool:
        action = argparse.BooleanOptionalAction
        parser.add_argument(flag, dest=parameter.name, action=action, default=default, help=meaning)
    elif get_origin(kind) is Literal:
        values = get_args(kind)
        parser.add_argument(
            flag,
            dest=parameter.name,
            type=type(values[0]),
            choices=values,
            default=default,
            required=needed,
            help=meaning,
        )
    else:
        read = _names if get_origin(kind) in (Sequence, list, tuple) else kind
        parser.add_argument(flag, dest=parameter.name, type=read, default=default, required=needed, help=meaning)  # type: ignore[arg-type]


def _names(words: str) -> list[str]:
    """Words separated by commas."""
    return [word for word in words.replace(",", " ").split() if word]


def prepare_run(name: str, arguments: Sequence[str]) -> int:
    """Prepare a data set and say what came of it.

    Returns:
        0, or 1 if a clip could not be written.
    """
    args = prepare_parser().parse_args(list(arguments))
    from facediff.data.prepare.runner import prepare

    _keep_apart(args.raw, args.out)
    try:
        report = prepare(make_plan(args), args.out, workers=args.workers, quiet=args.quiet)
    except KeyboardInterrupt:
        print(f"\nstopped; the same command goes on where {args.out} was left", file=sys.stderr)
        raise
    print("\n".join(describe(report)))
    return 0 if report.sound else 1


def make_plan(args: argparse.Namespace) -> Plan:
    """The plan that the arguments ask for."""
    plan = importlib.import_module(f"facediff.data.prepare.{args.corpus}").plan
    options = {option.name: getattr(args, option.name) for option in own_options(plan)}
    if "quiet" in inspect.signature(plan).parameters:  # scanning takes long enough for a progress bar
        options["quiet"] = args.quiet
    made: Plan = plan(args.raw, **options)
    return made


def describe(report: Report) -> list[str]:
    """The report as lines for the screen."""
    totals = report.totals
    lines = [
        f"{report.out}: {totals['clips']} clips, {totals['frames']} frames, {totals['seconds'] / 60:.1f} min, "
        f"{totals['bytes'] / 1e9:.2f} GB; {report.written} written now"
    ]
    for title, entries in (("missing", report.missing), ("failed", report.failed)):
        if entries:
            listed = grouped(entries)
            lines += [f"{title}: {len(entries)}", *(f"  {line}" for line in listed[:SHOWN])]
            if len(listed) > SHOWN:
                lines.append(f"  … and more, see {report.out / 'manifest.json'}")
    lines += [f"note: {note}" for note in report.notes[:SHOWN]]
    if len(report.notes) > SHOWN:
        lines.append(f"note: … and {len(report.notes) - SHOWN} more, see {report.out / 'manifest.json'}")
    lines.append(f"Next: facediff data check {report.out}")
    return lines


def grouped(entries: dict[str, str]) -> list[str]:
    """A line for each entry, but one line for clips of a subject whose texts differ in the clip's name only."""
    groups: dict[tuple[str, str], list[str]] = {}
    for key, text in entries.items():
        subject, _, sentence = key.rpartition("_")
        common = text.replace(key, "").replace(sentence, "") if subject else text
        groups.setdefault((subject or key, common), []).append(key)
    return [
        f"{keys[0]}{f' … {keys[-1]} ({len(keys)} in all)' if len(keys) > 1 else ''}: {entries[keys[0]]}"
        for keys in groups.values()
    ]


def _keep_apart(raw: Path, out: Path) -> None:
    """What is written must not be found as raw data by the next run."""
    source, target = raw.resolve(), out.resolve()
    if target == source or source in target.parents:
        raise FaceDiffError(f"{out}: lies in the raw folder {raw}; choose a folder outside it to write to")


# ``facediff data import-person``: a reconstructed video of one person becomes a corpus entry.


def import_person_parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data import-person",
        description="Turn the 3D reconstruction of one person's video into a corpus entry that any data module takes "
        "beside its own people (--data.people) and that `facediff animate --style` takes a style from.",
    )
    made.add_argument(
        "motion",
        type=Path,
        metavar="MOTION",
        help="folder of .obj or .ply files, one a frame; .npy of (frames, vertices, 3) or (frames, 3 vertices); or "
        "FLAME parameters: shape_pose_cam.hdf5, or .npy of (1, frames, 403)",
    )
    made.add_argument("--audio", type=Path, required=True, metavar="FILE", help="the video, or its sound")
    made.add_argument("--name", required=True, help="the person's name: letters, digits, dashes")
    made.add_argument(
        "--corpus", type=Path, required=True, metavar="ROOT", help="corpus of other people with the same topology"
    )
    made.add_argument("-o", "--output", type=Path, required=True, metavar="OUT", help="folder to make")
    made.add_argument("--frame-rate", type=float, required=True, metavar="N", help="frames a second of MOTION")
    made.add_argument(
        "--corpus-frame-rate",
        type=float,
        metavar="N",
        help="frames a second of the corpus; needed if ROOT has no manifest.json that tells",
    )
    made.add_argument(
        "--template",
        type=Path,
        metavar="FILE",
        help="neutral face (.obj, .ply, .npy) in MOTION's unit; without it, found where the person is silent and still",
    )
    made.add_argument(
        "--stable",
        metavar="FILE",
        help="text file with the indices of vertices that move with the skull only, or FLAME_masks.pkl:scalp+forehead; "
        "without it, the vertices that are found to move least",
    )
    made.add_argument("--flame", type=Path, metavar="MODEL", help="your FLAME model file, for FLAME parameters")
    made.add_argument(
        "--scale",
        type=float,
        metavar="FACTOR",
        help="corpus units to a unit of MOTION, e.g. 0.001; measured by default",
    )
    made.add_argument(
        "--clip-seconds", type=float, default=8.0, metavar="S", help="length of a clip, about (default: 8)"
    )
    made.add_argument("--quiet", action="store_true", help="no progress bar")
    return made


def import_person_run(name: str, arguments: Sequence[str]) -> int:
    """Import a person and print what was done; warnings go to standard error."""
    args = import_person_parser().parse_args(list(arguments))

    from facediff.data.corpus import read_manifest
    from facediff.data.person import import_person

    report = import_person(
        args.motion,
        audio=args.audio,
        name=args.name,
        corpus=args.corpus,
        output=args.output,
        frame_rate=args.frame_rate,
        corpus_frame_rate=args.corpus_frame_rate,
        template=args.template,
        stable=args.stable,
        flame=args.flame,
        scale=args.scale,
        clip_seconds=args.clip_seconds,
        progress=not args.quiet and sys.stderr.isatty(),
    )
    unit = read_manifest(args.output).get("unit")
    print(f"{args.output}: {report.name}")
    print("\n".join(report.lines(unit)))
    return 0


# ``facediff data regions``: a picture of the vertices that the scores of a corpus look at.

COLOURS: dict[str, tuple[int, int, int]] = {"lips": (214, 40, 57), "upper_face": (38, 102, 207)}
"""Colour (sRGB) of each region; vertices of both take the last."""

REST = (219, 209, 200)
"""Colour (sRGB) of all other vertices."""

VIEWS = {"front": "front", "three_quarter": "three-quarter"}
"""Views from left to right, with what is written above them."""


def regions_parser() -> argparse.ArgumentParser:
    """Options of the command."""
    made = argparse.ArgumentParser(
        "facediff data regions",
        description="Draw a corpus's lips and upper face, the vertices that LVE and FDD look at, on its mesh, with "
        "each region's name, vertex count and hash. Needs the corpus's mesh and region files, no clips.",
    )
    made.add_argument("root", type=Path, help="the corpus folder")
    made.add_argument(
        "-o", "--output", type=Path, default=Path("regions.png"), help="the picture (default: %(default)s)"
    )
    made.add_argument("--corpus", help="what the folder is: biwi, vocaset, mead3d, puppet, or package.module.Class")
    told = "in the folder, e.g. regions/lve.txt or FLAME_masks.pkl:lips; the corpus's own if not given"
    made.add_argument("--lips", metavar="SOURCE", help=f"file {told}")
    made.add_argument("--upper-face", metavar="SOURCE", help="likewise, e.g. FLAME_masks.pkl:forehead+eye_region")
    made.add_argument("--size", type=int, default=640, help="height of each view in pixels (default: %(default)s)")
    return made


def regions_run(name: str, arguments: Sequence[str]) -> int:
    """Draw the picture and print the regions, one a line.

    Raises:
        FaceDiffError: if the folder is no corpus, or its mesh or a region is missing or damaged.
    """
    args = regions_parser().parse_args(list(arguments))
    if args.output.suffix.lower() != ".png":
        raise FaceDiffError(f'picture file "{args.output}" must end in .png.')
    from facediff.data.corpus import find_region
    from facediff.render import save_image

    if args.corpus and "." in args.corpus:
        sys.path.append(os.getcwd())  # a data module of one's own may lie in the working folder
    root = args.root.expanduser()
    view = find_view(root, args.corpus)
    mesh = find_mesh(root, view)
    regions, lines = {}, {}
    for part, own in (("lips", args.lips), ("upper_face", args.upper_face)):
        sources = view.region_sources.get(part, ()) if own is None else (own,)
        regions[part] = find_region(root, sources, part, view.n_vertices, view.region_help)
        lines[part] = legend(root, sources, regions[part])
    title = f"{view.corpus}, {view.n_vertices} vertices"
    save_image(args.output, draw(mesh, regions, lines, title, args.size))
    print("\n".join([*lines.values(), f"wrote {args.output}"]))
    return 0


def find_view(root: Path, corpus: str | None) -> View:
    """What a folder is, told as ``facediff data check`` tells it.

    Args:
        root: the folder.
        corpus: name of the corpus, or import path of its data module; found out by itself if None.

    Raises:
        FaceDiffError: if there is no such folder or corpus, or the folder is not recognised.
    """
    if not root.is_dir():
        raise FaceDiffError(f"{root}: no such folder; expected a corpus folder with a mesh and regions/")
    from facediff.data.check import Report
    from facediff.data.check.layouts import MANIFEST, identify, list_folder, read_record
    from facediff.data.corpus import MOTION_FOLDERS

    report = Report(root, quick=True)
    manifest = read_record(root, MANIFEST, report.findings)
    folder = list_folder(root, MOTION_FOLDERS)
    view = identify(report, folder, manifest.get("corpus"), corpus, None, manifest)
    if view is None:
        raise FaceDiffError(f"{root}: {report.findings[-1].message}")
    return view


def find_mesh(root: Path, view: View) -> Mesh:
    """The corpus's mesh: its neutral vertices and its faces.

    Raises:
        FaceDiffError: if there is no mesh file, or it is none of this corpus.
    """
    from facediff.data.corpus import Corpus

    mesh = Corpus(root, view.n_vertices, view.frame_rate, stored_frame_rate=view.frame_rate).read_mesh(view.mesh_files)
    if mesh is None and not view.mesh_files:
        whose = "a person's folder" if view.data_module is None else view.corpus
        raise FaceDiffError(f"{root}: {whose} has no mesh of its own; give a corpus folder of the same topology")
    if mesh is None:
        wanted = " or ".join(view.mesh_files)
        raise FaceDiffError(f"{root}: no mesh to draw the regions on; put {wanted} into this folder")
    return mesh


def legend(root: Path, sources: Sequence[str], region: Region) -> str:
    """A region in one line: name, vertex count, hash, source, and how often its source repeats itself."""
    used = next((source for source in sources if (root / source.partition(":")[0]).is_file()), sources[0])
    repeated = f", {region.duplicates} repeated indices counted once" if region.duplicates else ""
    return f"{region} from {used}{repeated}"


def draw(mesh: Mesh, regions: dict[str, Region], lines: dict[str, str], title: str, size: int) -> npt.NDArray[np.uint8]:
    """The picture: the views side by side, the regions coloured, a line in its colour for each below.

    Args:
        mesh: what to draw on.
        regions: vertices by name, the names of `COLOURS`.
        lines: text for each region.
        title: text for all.
        size: height and width of each view in pixels.

    Returns:
        (height, width, 3), sRGB.
    """
    import numpy as np

    from facediff.render import Renderer, side_by_side
    from facediff.render.panels import draw_text

    colours = np.full((len(mesh.vertices), 3), REST, np.uint8)
    for part, region in regions.items():
        colours[list(region.indices)] = COLOURS[part]
    renderers = [Renderer(mesh.faces, template=mesh.vertices, size=size, view=view, colours=colours) for view in VIEWS]
    still = [mesh.vertices[None]] * len(VIEWS)
    picture = next(side_by_side(renderers, still, list(VIEWS.values()), footer=title))
    blank = np.full((max(size // 16, 20), picture.shape[1], 3), 255, np.uint8)
    strips = [draw_text(blank, line, colour=COLOURS[part], scale=0.5) for part, line in lines.items()]
    return np.concatenate([picture, *strips])


COMMANDS = {
    "prepare": (prepare_run, "make a corpus folder from a raw distribution: biwi, vocaset, mead3d"),
    "check": (check_run, "say what a folder is, what is missing and what is wrong in it"),
    "regions": (regions_run, "draw a corpus's lips and upper face on its mesh"),
    "import-person": (import_person_run, "make a person's reconstructed video a corpus entry"),
}


def usage() -> str:
    """The help text."""
    lines = ["usage: facediff data <command> [options]", "", "commands:"]
    lines += [f"  {name:<16}{text}" for name, (_, text) in COMMANDS.items()]
    return "\n".join([*lines, "", "`facediff data <command> --help` tells a command's options"])


def run(name: str, arguments: Sequence[str]) -> int:
    """Find the subcommand and hand over.

    Raises:
        FaceDiffError: if there is no such subcommand.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage())
        return 0 if arguments else 2
    command, *rest = arguments
    if command not in COMMANDS:
        raise FaceDiffError(f'there is no command "data {command}": {choices(command, COMMANDS)}')
    status: int = COMMANDS[command][0](f"data {command}", rest)
    return status
