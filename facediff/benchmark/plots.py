"""Plots of a benchmark: error over steps and over time, sentence by sentence, and error over speed."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from facediff.benchmark.results import Result
from facediff.benchmark.tables import BenchmarkReport, Table
from facediff.errors import printable
from facediff.reporting.documents import Drawing
from facediff.reporting.drawing import GREY, line_style, listed, plot_svg, point_style
from facediff.reporting.scores import ScoreMatrix

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LOSS = "val/lve"
Points = list[tuple[float, float]]


def plots_of(table: Table, report: BenchmarkReport) -> dict[str, Drawing]:
    """The plots of a table by name, without empty ones."""
    drawings = {
        "steps": curves_plot(table, report, "step"),
        "time": curves_plot(table, report, "seconds"),
        "sentences": scatter_plot(table),
        "speed": speed_plot(table),
    }
    return {name: drawing for name, drawing in drawings.items() if drawing is not None}


def main_column(table: Table) -> str:
    """The score that is drawn: LVE where there is one."""
    return "lve" if "lve" in table.columns else next(iter(table.columns))


def curves_plot(table: Table, report: BenchmarkReport, over: str) -> Drawing | None:
    """LVE of validation over the steps of training, or over its time, mean over the runs; None without curves."""
    lines: list[tuple[str, Points]] = []  # several rows may have one label
    for row in table.rows:
        runs = [result for result in report.results if (result.row, result.corpus) == (row.name, table.corpus)]
        if not row.reference and (points := mean_curve(runs, over)):
            lines.append((printable(row.label), points))
    if not any(len(points) > 1 for _, points in lines):
        return None
    title = "optimiser steps" if over == "step" else "seconds of training"

    def draw(axes: Axes) -> None:
        for number, (label, points) in enumerate(lines):
            axes.plot(*zip(*points, strict=True), label=listed(label), marker="o", markersize=3, **line_style(number))
        axes.set_xlabel(title)
        axes.locator_params(axis="x", nbins=6, integer=over == "step")
        axes.set_ylabel("LVE of validation")

    caption = f"LVE of validation over {title}, mean over training runs"
    return Drawing(plot_svg(draw, caption), caption)


def mean_curve(runs: list[Result], over: str) -> Points:
    """Mean over the runs of each validation: when it was, and its LVE; as many as all runs have."""
    curves = [run.curve for run in runs if not run.problem and run.curve.get(LOSS)]
    curves = [curve for curve in curves if len(curve.get(over) or ()) == len(curve[LOSS])]
    points = []
    for index in range(min((len(curve[LOSS]) for curve in curves), default=0)):
        values = [(curve[over][index], curve[LOSS][index]) for curve in curves]
        logged = [(x, y) for x, y in values if x is not None and y is not None]
        if logged:
            x, y = np.mean(logged, axis=0)
            points.append((float(x), float(y)))
    return points


def scatter_plot(table: Table) -> Drawing | None:
    """Each sentence's error in every row against its error in the baseline; below the line, the row is better."""
    column = main_column(table)
    baseline = table.row(table.baseline)
    base = baseline.scores.get(column)
    if base is None or base.table is None:
        return None
    reference = means_of(base.table)
    clouds: list[tuple[str, Points]] = []
    for row in table.rows:
        scores = row.scores.get(column)
        if row.name != table.baseline and not row.reference and scores is not None and scores.table is not None:
            means = means_of(scores.table).items()
            clouds.append(
                (printable(row.label), [(reference[clip], value) for clip, value in means if clip in reference])
            )
    values = [value for _, points in clouds for point in points for value in point]
    if not values:
        return None

    def draw(axes: Axes) -> None:
        room = 0.06 * (max(values) - min(values)) or abs(max(values)) * 0.1 or 1.0
        ends = (min(values) - room, max(values) + room)
        axes.plot(ends, ends, color=GREY, linestyle=":", linewidth=0.8)
        for number, (label, points) in enumerate(clouds, 1):
            axes.plot(*zip(*points, strict=True), label=listed(label), linestyle="", **point_style(number))
        axes.set(xlim=ends, ylim=ends, ylabel=f"{column} of the row")
        axes.set_xlabel(f"{column} of {printable(baseline.label)[:40]}".replace("$", r"\$"))

    return Drawing(
        plot_svg(
            draw,
            caption := f"{column} sentence by sentence, mean over training runs: below the line, the row is better",
        ),
        caption,
    )


def means_of(table: ScoreMatrix) -> dict[str, float]:
    """The mean over the runs of each sentence."""
    counts = (table.weights > 0).sum(1)
    return dict(zip(table.clips, (table.values.sum(1) / counts).tolist(), strict=True))


def speed_plot(table: Table) -> Drawing | None:
    """Error over real-time factor."""
    column = main_column(table)
    rows = [row for row in table.rows if row.cost.factor and column in row.scores]
    if len(rows) < 2:
        return None

    def draw(axes: Axes) -> None:
        for number, row in enumerate(rows):
            point = ([row.cost.factor or 0.0], [row.scores[column].mean])
            axes.plot(*point, label=listed(printable(row.label)), linestyle="", **point_style(number))
        axes.set(xscale="log", xlabel="real-time factor", ylabel=column)
        axes.margins(0.08)
        for formatter in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
            formatter("{x:.3g}")

    return Drawing(
        plot_svg(draw, caption := f"{column} over seconds of computing for a second of speech; lower left is better"),
        caption,
    )
