"""Figures of numbers at vertices: how much each vertex moves, and how far it is from the truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from torch import Tensor

from facediff.evaluation.figures.material import FLAT, TRUTH, Array, FigureData, Painter, chunks, shortest
from facediff.evaluation.figures.page import GAP, Grid, Heading, Paper, check_output, save, style, wrapped
from facediff.reporting.drawing import SMALLEST_TEXT, plain
from facediff.utils import ranges
from facediff.utils.jobs import in_order, run_tasks

HIGHEST = 70.0  # Largest height of a picture in mm
BAR, BAR_SPACE = 2.5, 16.0  # Width of a colour bar, and of the bar with its numbers and label, in mm

Statistic = Literal["mean", "max", "both"]
Row = tuple[str, dict[str, Array], float | None]
"""A row of pictures with one colour scale: the bar's label without the unit, numbers (V,) by column in the vertices'
unit, and the value of the last colour in the unit shown, or None for the largest value."""


@dataclass(frozen=True)
class VertexMap:
    """A number at each vertex, in the vertices' unit."""

    mean: Array  # over frames (V,)
    deviation: Array  # population standard deviation over frames (V,)
    maximum: Array  # over frames (V,)
    frames: int


def motion_maps(
    material: FigureData, clips: Sequence[str], *, workers: int | None = None, scheduler: str | None = ""
) -> tuple[dict[str, VertexMap], list[str]]:
    """The distance of each vertex from the template over all frames of the clips, by name, truth first; and notes.

    Where lengths differ, only common frames are used, so that the panels of a figure are comparable. Digits do not
    depend on ``workers`` or ``scheduler`` (:func:`facediff.utils.jobs.run_tasks`).
    """
    return _vertex_maps(material, clips, material.names, _from_template, workers, scheduler)


def _from_template(
    material: FigureData, clip: str, name: str, motions: Mapping[str, Tensor], frames: int
) -> Iterator[Array]:
    template = material.template(clip)
    for part in chunks(motions[name], material.path(clip, name), frames):
        yield np.linalg.norm(part - template, axis=2)


def error_maps(
    material: FigureData, clips: Sequence[str], *, workers: int | None = None, scheduler: str | None = ""
) -> tuple[dict[str, VertexMap], list[str]]:
    """The distance of each vertex from the truth's over all frames of the clips, by method; and notes."""
    return _vertex_maps(material, clips, list(material.methods), _from_truth, workers, scheduler)


def _from_truth(
    material: FigureData, clip: str, name: str, motions: Mapping[str, Tensor], frames: int
) -> Iterator[Array]:
    truths = chunks(motions[TRUTH], material.path(clip, TRUTH), frames)
    for part, truth in zip(chunks(motions[name], material.path(clip, name), frames), truths, strict=True):
        yield np.linalg.norm(part - truth, axis=2)


Distances = Callable[[FigureData, str, str, Mapping[str, Tensor], int], Iterator[Array]]
"""Distances (n, V) of a clip (its name, a method's name, all motions, frames), a few frames at a time."""


@dataclass(frozen=True)
class _Part:
    """The statistics of every vertex over some consecutive frames."""

    frames: int
    mean: Array  # (V,)
    squares: Array  # sum of squared deviations from the mean (V,)
    maximum: Array  # (V,)


def _parts(
    material: FigureData, distances: Distances, names: Sequence[str], task: tuple[int, str]
) -> tuple[str, list[list[_Part]]]:
    """The statistics of a clip, by name, and a note on omitted frames; numbered, since clips may repeat."""
    _, clip = task
    motions = material.open(clip)
    frames, note = shortest(motions)
    parts: list[list[_Part]] = []
    for name in names:
        parts.append([])
        for values in distances(material, clip, name, motions, frames):
            mean = values.mean(0)
            parts[-1].append(_Part(len(values), mean, ((values - mean) ** 2).sum(0), values.max(0)))
    return f"{clip}: {note}" if note else "", parts


def _vertex_maps(
    material: FigureData,
    clips: Sequence[str],
    names: Sequence[str],
    distances: Distances,
    workers: int | None,
    scheduler: str | None,
) -> tuple[dict[str, VertexMap], list[str]]:
    """Statistics by name of the distances that a function gives for a clip."""
    count = dict.fromkeys(names, 0)
    mean, squares, maximum = ({name: np.zeros(material.n_vertices) for name in names} for _ in range(3))
    notes = []
    work = partial(_parts, material, distances, names)
    reads = {material.path(clip, name).parent for clip in clips for name in material.names}
    tasks = list(enumerate(clips))
    results = run_tasks(work, tasks, workers=workers, mode="threads", scheduler=scheduler, reads=sorted(reads))
    with closing(results):
        for _, (note, parts) in in_order(results, tasks):
            notes += [note] if note else []
            for name, part in ((name, part) for name, some in zip(names, parts, strict=True) for part in some):
                # Chan, Golub and LeVeque's update (1983) of mean and sum of squared deviations: exact to rounding for
                # any number of frames, where a difference of sums of squares is not.
                before, count[name] = count[name], count[name] + part.frames
                apart = part.mean - mean[name]
                weight = part.frames / count[name]
                squares[name] += part.squares + apart**2 * (before * weight)
                mean[name] += apart * weight
                maximum[name] = np.maximum(maximum[name], part.maximum)
    maps = {
        name: VertexMap(mean[name], np.sqrt(squares[name] / max(count[name], 1)), maximum[name], count[name])
        for name in names
    }
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
    workers: ranges.Workers | None = None,
    scheduler: str | None = "",
) -> list[str]:
    """Draw mean and standard deviation over time of each vertex's distance from the template, truth and methods.

    Args:
        material: of the evaluation.
        clips: names of clips.
        output: ``.png``, ``.pdf`` or ``.svg``.
        paper: width, resolution and font.
        view: a name in :data:`facediff.render.VIEWS`.
        highest: ends of the colour scales of mean and deviation, in the unit shown; the largest value if None.
        workers: clips read at a time; as of :func:`motion_maps`.
        scheduler: where clips are read; see :func:`facediff.utils.jobs.run_tasks`.

    Returns:
        notes on omissions.
    """
    rows = {"mean of motion": "mean", "std of motion": "deviation"}
    reading = partial(motion_maps, workers=workers, scheduler=scheduler)
    return _draw_maps(material, clips, output, reading, rows, highest, paper or Paper(), view)


@ranges.checked
def draw_error(
    material: FigureData,
    clips: Sequence[str],
    output: Path,
    *,
    paper: Paper | None = None,
    view: str = "front",
    statistic: Statistic = "mean",
    highest: tuple[ranges.Factor | None, ranges.Factor | None] = (None, None),
    workers: ranges.Workers | None = None,
    scheduler: str | None = "",
) -> list[str]:
    """Draw how far each vertex is from the truth's, mean or maximum over frames, a column for each method.

    Arguments, result and errors are as for :func:`draw_heatmap`; ``statistic`` is ``mean``, ``max``, or ``both``, a
    row each, and ``highest`` has the ends of the colour scales of mean and maximum.
    """
    rows = {"mean error": "mean", "maximum error": "maximum"}
    selected = {label: name for label, name in rows.items() if label.startswith(statistic) or statistic == "both"}
    ends = (highest[1], None) if statistic == "max" else highest
    reading = partial(error_maps, workers=workers, scheduler=scheduler)
    return _draw_maps(material, clips, output, reading, selected, ends, paper or Paper(), view)


def _draw_maps(
    material: FigureData,
    clips: Sequence[str],
    output: Path,
    reading: Callable[[FigureData, Sequence[str]], tuple[dict[str, VertexMap], list[str]]],
    rows: Mapping[str, str],
    highest: tuple[float | None, float | None],
    paper: Paper,
    view: str,
) -> list[str]:
    """Draw a row for each label and the its attribute of the maps; notes on omissions."""
    check_output(output)
    material.mesh(clips)  # refuses before the work
    maps, notes = reading(material, clips)
    pictures: list[Row] = [
        (label, {name: getattr(vertex_map, attribute) for name, vertex_map in maps.items()}, end)
        for (label, attribute), end in zip(rows.items(), highest, strict=False)
    ]
    _draw(material, clips, pictures, output, paper, view)
    return notes


def _draw(
    material: FigureData, clips: Sequence[str], rows: Sequence[Row], output: Path, paper: Paper, view: str
) -> None:
    from facediff.render.panels import heat_colours

    factor, unit = material.scale
    ends = [scale_end(values, factor, highest) for _, values, highest in rows]
    faces, shape = material.mesh(clips)
    painter = Painter(faces, shape, view=view, look=FLAT)
    names = list(rows[0][1])
    with style(paper):
        grid = Grid(
            paper,
            [""] * len(rows),
            [Heading(name) for name in names],
            aspect=painter.aspect,
            highest=HIGHEST,
            right=BAR_SPACE + 2 * GAP,
            remark=material.remark,
        )
        painter.set_size(*grid.pixels)
        figure = grid.draw_labels()
        for number, ((label, values, _), end) in enumerate(zip(rows, ends, strict=True)):
            for column, name in enumerate(names):
                colours = heat_colours(values[name] * factor, end)
                grid.picture(painter.paint(shape, colours), number, column)
            beyond = max(float(array.max()) for array in values.values()) * factor > end * (1 + 1e-9)
            _draw_bar(grid, number, end, f"{label} [{unit}]", beyond=beyond)
        save(figure, output)


def scale_end(values: Mapping[str, Array], factor: float, highest: float | None) -> float:
    """Value of a row's last colour, in the unit shown."""
    if highest is not None:
        return highest
    largest = max(float(array.max()) for array in values.values()) * factor
    return largest if largest > 0 else 1.0  # nothing moves: any scale is right


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
