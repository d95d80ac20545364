"""Figures of numbers at vertices: how much each vertex moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facediff.evaluation.figures.material import FLAT, Array, FigureData, Painter, chunks, shortest
from facediff.evaluation.figures.page import (
    GAP,
    SMALLEST_TEXT,
    Grid,
    Heading,
    Paper,
    check_output,
    plain,
    save,
    style,
    wrapped,
)
from facediff.utils import ranges

HIGHEST = 70.0  # Largest height of a picture in mm
BAR, BAR_SPACE = 2.5, 16.0  # Width of a colour bar, and of the bar with its numbers and label, in mm


@dataclass(frozen=True)
class VertexMap:
    """A number at each vertex, in the vertices' unit."""

    mean: Array  # over frames (V,)
    deviation: Array  # population standard deviation over frames (V,)
    frames: int


def motion_maps(material: FigureData, clips: Sequence[str]) -> tuple[dict[str, VertexMap], list[str]]:
    """The distance of each vertex from the template over all frames of the clips, by name, truth first; and notes.

    Where lengths differ, only common frames are used, so that the panels of a figure are comparable.
    """
    count = dict.fromkeys(material.names, 0)
    mean, squares = ({name: np.zeros(material.n_vertices) for name in material.names} for _ in range(2))
    notes = []
    for clip in clips:
        motions, template = material.open(clip), material.template(clip)
        frames, note = shortest(motions)
        notes += [f"{clip}: {note}"] if note else []
        for name, motion in motions.items():
            for part in chunks(motion, material.path(clip, name), frames):
                distances = np.linalg.norm(part - template, axis=2)
                # Chan, Golub and LeVeque's update (1983) of mean and sum of squared deviations: exact to rounding for
                # any number of frames, where a difference of sums of squares is not.
                before, count[name] = count[name], count[name] + len(distances)
                apart, weight = distances.mean(0) - mean[name], len(distances) / count[name]
                squares[name] += ((distances - distances.mean(0)) ** 2).sum(0) + apart**2 * (before * weight)
                mean[name] += apart * weight
    maps = {name: VertexMap(mean[name], np.sqrt(squares[name] / max(n, 1)), n) for name, n in count.items()}
    return maps, notes


@ranges.checked
def draw_heatmap(
    material: FigureData,
    clips: Sequence[str],
    output: Path,
    *,
    paper: Paper | None = None,
    view: str = "front",
    highest: tuple[ranges.Factor | None, ranges.Factor | None] = (None, None),
) -> list[str]:
    """Draw mean and standard deviation over time of each vertex's distance from the template, truth and methods.

    ``view`` is a name in :data:`facediff.render.VIEWS`; ``highest`` has the ends of the colour scales of mean and
    deviation, in the unit shown, where they are not the largest values. The result is notes on omissions.
    """
    from facediff.render.panels import heat_colours

    check_output(output)
    paper = paper or Paper()
    faces, shape = material.mesh(clips)
    maps, notes = motion_maps(material, clips)
    factor, unit = material.scale
    painter = Painter(faces, shape, view=view, look=FLAT)
    with style(paper):
        headings = [Heading(name) for name in maps]
        options = {"aspect": painter.aspect, "highest": HIGHEST, "right": BAR_SPACE + 2 * GAP}
        grid = Grid(paper, ["", ""], headings, remark=material.remark, **options)
        painter.set_size(*grid.pixels)
        figure = grid.draw_labels()
        rows = {"mean of motion": "mean", "std of motion": "deviation"}
        for row, ((label, attribute), limit) in enumerate(zip(rows.items(), highest, strict=True)):
            values = [getattr(vertex_map, attribute) * factor for vertex_map in maps.values()]
            largest = float(np.max(values))
            end = limit or largest or 1.0  # where nothing moves, any scale is right
            for column, numbers in enumerate(values):
                grid.picture(painter.paint(shape, heat_colours(numbers, end)), row, column)
            _draw_bar(grid, row, end, f"{label} [{unit}]", beyond=largest > end * (1 + 1e-9))
        save(figure, output)
    return notes


def _draw_bar(grid: Grid, row: int, end: float, label: str, *, beyond: bool) -> None:
    """A colour bar at the right of a row, with exactly the colours that the meshes have."""
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.ticker import MaxNLocator

    from facediff.render.panels import heat_ramp

    _, top = grid.place(row, 0)
    height = min(grid.height * 0.9, 45.0)
    axes = grid.axes(grid.end + 2 * GAP, top + (grid.height - height) / 2, BAR, height)
    mappable = ScalarMappable(Normalize(0, end), ListedColormap(heat_ramp() / 255))
    bar = grid.figure.colorbar(mappable, cax=axes, extend="max" if beyond else "neither")
    lines = wrapped(label, grid.height, SMALLEST_TEXT, grid.paper.font)  # must not overlap the next row's
    bar.set_label(plain("\n".join(lines)), size=SMALLEST_TEXT)
    bar.outline.set_linewidth(0.4)
    bar.locator = MaxNLocator(5, steps=[1, 2, 2.5, 5, 10])
    bar.update_ticks()
