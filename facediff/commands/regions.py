"""``facediff data regions``: a picture of the vertices that the scores of a corpus look at."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from facediff.doctor.view import View
    from facediff.metrics import Region
    from facediff.topology.mesh import Mesh

COLOURS: dict[str, tuple[int, int, int]] = {"lips": (214, 40, 57), "upper_face": (38, 102, 207)}
"""Colour (sRGB) of each region; vertices of both take the last."""

REST = (219, 209, 200)
"""Colour (sRGB) of all other vertices."""

VIEWS = {"front": "front", "three_quarter": "three-quarter"}
"""Views from left to right, with what is written above them."""


def parser() -> argparse.ArgumentParser:
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


def run(name: str, arguments: Sequence[str]) -> int:
    """Draw the picture and print the regions, one a line.

    Raises:
        FaceDiffError: if the folder is no corpus, or its mesh or a region is missing or damaged.
    """
    args = parser().parse_args(list(arguments))
    if args.output.suffix.lower() != ".png":
        raise FaceDiffError(f'picture file "{args.output}" must end in .png.')
    from facediff.data.regions import find_region
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
    from facediff.data.corpus import MOTION_FOLDERS
    from facediff.doctor import Report
    from facediff.doctor.folder import list_folder
    from facediff.doctor.identify import identify
    from facediff.doctor.manifest import MANIFEST, read_record

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
    from facediff.render.text import draw_text

    colours = np.full((len(mesh.vertices), 3), REST, np.uint8)
    for part, region in regions.items():
        colours[list(region.indices)] = COLOURS[part]
    renderers = [Renderer(mesh.faces, template=mesh.vertices, size=size, view=view, colours=colours) for view in VIEWS]
    still = [mesh.vertices[None]] * len(VIEWS)
    picture = next(side_by_side(renderers, still, list(VIEWS.values()), footer=title))
    blank = np.full((max(size // 16, 20), picture.shape[1], 3), 255, np.uint8)
    strips = [draw_text(blank, line, colour=COLOURS[part], scale=0.5) for part, line in lines.items()]
    return np.concatenate([picture, *strips])
