"""A picture of the vertices that LVE and FDD use: a corpus's lips and upper face, drawn on its mesh."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.check.layouts import view_of
from facediff.data.corpus import Corpus, find_region
from facediff.errors import FaceDiffError
from facediff.mesh.mesh import Mesh
from facediff.metrics import Region
from facediff.render import Renderer, save_image, side_by_side
from facediff.render.panels import draw_text
from facediff.utils import ranges

COLOURS: dict[str, tuple[int, int, int]] = {"lips": (214, 40, 57), "upper_face": (38, 102, 207)}
"""Colour (sRGB) of each region; vertices of both have the last."""

REST = (219, 209, 200)  # Colour (sRGB) of all other vertices
VIEWS = {"front": "front", "three_quarter": "three-quarter"}  # Views from left to right, with the text above them


@ranges.checked
def draw_regions(
    root: Path,
    output: Path,
    *,
    corpus: str | None = None,
    lips: str | None = None,
    upper_face: str | None = None,
    size: ranges.Pixels = 640,
) -> list[str]:
    """Draw a corpus's lips and upper face, the vertices that LVE and FDD use, on its mesh.

    Args:
        root: the corpus folder; its mesh and region files are needed, no clips.
        output: the picture (.png).
        corpus: a corpus's name, or the import path of its data module; recognised if None.
        lips: source of the lips; the corpus's own if None.
        upper_face: source of the upper face; the corpus's own if None.
        size: height of each view in pixels.

    Returns:
        a line for each region: name, vertex count, hash, source.
    """
    view = view_of(root, corpus)
    mesh = Corpus(root, view.n_vertices, view.frame_rate, stored_frame_rate=view.frame_rate).read_mesh(view.mesh_files)
    if mesh is None:
        names = " or ".join(view.mesh_files)
        advice = f"put {names} into this folder" if names else "give a corpus folder of the same topology"
        raise FaceDiffError(f"{root}: no mesh to draw the regions on; {advice}")
    regions, lines = {}, {}
    for part, source in (("lips", lips), ("upper_face", upper_face)):
        sources = view.region_sources.get(part, ()) if source is None else (source,)
        regions[part] = find_region(root, sources, part, view.n_vertices, view.region_help)
        lines[part] = legend(root, sources, regions[part])
    save_image(output, draw(mesh, regions, lines, f"{view.corpus}, {view.n_vertices} vertices", size))
    return list(lines.values())


def legend(root: Path, sources: Sequence[str], region: Region) -> str:
    """A region in one line: name, vertex count, hash, source, and how many indices its source repeats."""
    file = next((source for source in sources if (root / source.partition(":")[0]).is_file()), sources[0])
    repeated = f", {region.duplicates} repeated indices counted once" if region.duplicates else ""
    return f"{region} from {file}{repeated}"


def draw(mesh: Mesh, regions: dict[str, Region], lines: dict[str, str], title: str, size: int) -> npt.NDArray[np.uint8]:
    """The views side by side (height, width, 3), the regions coloured, a line in its colour for each below."""
    colours = np.full((len(mesh.vertices), 3), REST, np.uint8)
    for part, region in regions.items():
        colours[list(region.indices)] = COLOURS[part]
    renderers = [Renderer(mesh.faces, template=mesh.vertices, size=size, view=view, colours=colours) for view in VIEWS]
    still = [mesh.vertices[None]] * len(VIEWS)
    picture = next(side_by_side(renderers, still, list(VIEWS.values()), footer=title))
    blank = np.full((max(size // 16, 20), picture.shape[1], 3), 255, np.uint8)
    strips = [draw_text(blank, line, colour=COLOURS[part], scale=0.5) for part, line in lines.items()]
    return np.concatenate([picture, *strips])
