"""Plots of a benchmark as SVG: error over steps and over time, sentence by sentence, and error over speed.

Drawn by hand, so that a report needs no drawing library and a page no network.
"""

from __future__ import annotations

import html
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from facediff.benchmark.tables import BenchmarkReport, Table

WIDTH, HEIGHT = 460, 300
LEFT, RIGHT, TOP, BOTTOM = 64, 12, 12, 44
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#8C564B", "#7F7F7F")
"""Okabe and Ito's colours (2008), without yellow, and two more."""
DASHES = ("", "6 2", "2 2", "6 2 2 2")


@dataclass(frozen=True)
class Panel:
    """A plot with what stands below it."""

    svg: str
    caption: str


@dataclass
class Axes:
    """A coordinate system that is drawn into.

    Attributes:
        across: ends of the horizontal axis.
        upright: ends of the vertical axis.
        titles: of the two.
        log: whether the horizontal axis is logarithmic.
        parts: what is drawn.
    """

    across: tuple[float, float]
    upright: tuple[float, float]
    titles: tuple[str, str]
    log: bool = False
    parts: list[str] = field(default_factory=list)
    legend: list[tuple[str, str, str]] = field(default_factory=list)

    def x(self, value: float) -> float:
        """Place of a value on the horizontal axis, in pixels."""
        low, high = self.across
        share = math.log(value / low) / math.log(high / low) if self.log else (value - low) / (high - low)
        return LEFT + share * (WIDTH - LEFT - RIGHT)

    def y(self, value: float) -> float:
        """Place of a value on the vertical axis, in pixels."""
        low, high = self.upright
        return HEIGHT - BOTTOM - (value - low) / (high - low) * (HEIGHT - TOP - BOTTOM)

    def line(self, points: Sequence[tuple[float, float]], number: int, name: str) -> None:
        """A line with a mark at every point."""
        colour, dash = look(number)
        places = " ".join(f"{self.x(x):.1f},{self.y(y):.1f}" for x, y in points)
        self.parts.append(
            f'<polyline points="{places}" fill="none" stroke="{colour}" stroke-width="1.6" stroke-dasharray="{dash}"/>'
        )
        self.dots(points, number, "")
        self.legend.append((name, colour, dash))

    def dots(self, points: Sequence[tuple[float, float]], number: int, name: str) -> None:
        """A dot at every point."""
        colour, dash = look(number)
        self.parts += [
            f'<circle cx="{self.x(x):.1f}" cy="{self.y(y):.1f}" r="2.6" fill="{colour}" fill-opacity="0.8"/>'
            for x, y in points
        ]
        if name:
            self.legend.append((name, colour, dash))

    def diagonal(self) -> None:
        """Where both coordinates are equal."""
        low = max(self.across[0], self.upright[0])
        high = min(self.across[1], self.upright[1])
        self.parts.append(
            f'<line x1="{self.x(low):.1f}" y1="{self.y(low):.1f}" x2="{self.x(high):.1f}" y2="{self.y(high):.1f}" '
            f'stroke="#888" stroke-dasharray="3 3"/>'
        )

    def svg(self) -> str:
        """The finished plot, with its axes and its legend below."""
        escaped = [html.escape(title) for title in self.titles]
        rows = -(-len(self.legend) // 2)
        height = HEIGHT + 16 * rows + (6 if rows else 0)
        base = HEIGHT - BOTTOM
        parts = [f'<path d="M{LEFT},{TOP} V{base} H{WIDTH - RIGHT}" fill="none" stroke="#333"/>']
        for value in ticks(*self.across, log=self.log):
            x = self.x(value)
            parts.append(f'<path d="M{x:.1f},{base} v4" stroke="#333"/>')
            parts.append(f'<text x="{x:.1f}" y="{base + 16}" text-anchor="middle">{value:.4g}</text>')
        for value in ticks(*self.upright):
            y = self.y(value)
            parts.append(f'<path d="M{LEFT},{y:.1f} h-4" stroke="#333"/>')
            parts.append(f'<text x="{LEFT - 7}" y="{y + 4:.1f}" text-anchor="end">{value:.3g}</text>')
        middle = (LEFT + WIDTH - RIGHT) / 2
        parts.append(f'<text x="{middle}" y="{base + 34}" text-anchor="middle">{escaped[0]}</text>')
        turn = f"translate(13,{(TOP + base) / 2}) rotate(-90)"
        parts.append(f'<text transform="{turn}" text-anchor="middle">{escaped[1]}</text>')
        for place, (name, colour, dash) in enumerate(self.legend):
            x, y = 14 + (place % 2) * WIDTH / 2, HEIGHT + 8 + 16 * (place // 2)
            parts.append(
                f'<line x1="{x}" y1="{y}" x2="{x + 22}" y2="{y}" stroke="{colour}" stroke-width="2.4" '
                f'stroke-dasharray="{dash}"/><text x="{x + 28}" y="{y + 4}">{html.escape(name[:34])}</text>'
            )
        label = html.escape(f"{self.titles[1]} over {self.titles[0]}", quote=True)
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {height}" width="{WIDTH}" height="{height}" '
            f'role="img" aria-label="{label}" font-family="sans-serif" font-size="11">'
            f'<rect width="{WIDTH}" height="{height}" fill="#fff"/>{"".join([*self.parts, *parts])}</svg>'
        )


def look(number: int) -> tuple[str, str]:
    """Colour and dashes of a row."""
    return COLOURS[number % len(COLOURS)], DASHES[number // len(COLOURS) % len(DASHES)]


def ticks(low: float, high: float, *, log: bool = False) -> list[float]:
    """Round numbers between two ends."""
    if log:
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        ticks_of_decades = [base * 10.0**power for power in powers for base in (1, 2, 5)]
        return [value for value in ticks_of_decades if low <= value <= high]
    step = 10.0 ** math.floor(math.log10((high - low) / 4))
    step *= next(factor for factor in (1, 2, 5, 10) if (high - low) / (factor * step) <= 6)
    first = math.ceil(low / step)
    return [place * step for place in range(first, math.floor(high / step + 1e-9) + 1)]


def ends(values: Sequence[float], *, log: bool = False) -> tuple[float, float]:
    """The ends of an axis that shows all values, with some room."""
    low, high = min(values), max(values)
    if log:
        return low / 1.3, high * 1.3
    room = 0.06 * (high - low) or abs(high) * 0.1 or 1.0
    return low - room, high + room


def main_column(table: Table) -> str:
    """The score that is drawn: LVE where there is one."""
    return "lve" if "lve" in table.columns else next(iter(table.columns))


def curves_plot(table: Table, report: BenchmarkReport, over: str) -> Panel | None:
    """LVE of validation over the steps of training, or over its time, mean over the runs; None where nothing is."""
    lines = []
    for row in table.rows:
        runs = [
            result.curve
            for result in report.results
            if not result.problem and not row.reference and (result.row, result.corpus) == (row.name, table.corpus)
        ]
        runs = [curve for curve in runs if curve.get("val/lve") and len(curve.get(over) or ()) == len(curve["val/lve"])]
        length = min((len(curve["val/lve"]) for curve in runs), default=0)
        points = []
        for place in range(length):
            values = [(curve[over][place], curve["val/lve"][place]) for curve in runs]
            finite = [(x, y) for x, y in values if x is not None and y is not None]
            if finite:
                points.append((float(np.mean([x for x, _ in finite])), float(np.mean([y for _, y in finite]))))
        if points:
            lines.append((row.label, points))
    every = [point for _, points in lines for point in points]
    if not any(len(points) > 1 for _, points in lines):
        return None
    title = "optimiser steps" if over == "step" else "seconds of training"
    axes = Axes(ends([x for x, _ in every]), ends([y for _, y in every]), (title, "LVE of validation"))
    for number, (label, points) in enumerate(lines):
        axes.line(points, number, label)
    return Panel(axes.svg(), f"LVE of validation over {title}, mean over training runs")


def scatter_plot(table: Table, report: BenchmarkReport) -> Panel | None:
    """Each sentence's error in every row against its error in the baseline; below the line, the row is better."""
    del report
    column = main_column(table)
    base = table.row(table.baseline).scores.get(column)
    rows = [row for row in table.rows if row.name != table.baseline and not row.reference and column in row.scores]
    if base is None or base.values is None or not rows:
        return None
    own = dict(zip(base.clips, np.nanmean(base.values, 0).tolist(), strict=True))
    drawn = []
    for row in rows:
        scores = row.scores[column]
        if scores.values is not None:
            means = np.nanmean(scores.values, 0).tolist()
            points = [(own[clip], value) for clip, value in zip(scores.clips, means, strict=True) if clip in own]
            drawn.append((row.label, points))
    every = [value for _, points in drawn for point in points for value in point]
    if not every:
        return None
    both = ends(every)
    axes = Axes(both, both, (f"{column} of {table.row(table.baseline).label}", f"{column} of the row"))
    axes.diagonal()
    for number, (label, points) in enumerate(drawn):
        axes.dots(points, number + 1, label)
    return Panel(
        axes.svg(), f"{column} sentence by sentence, mean over training runs: below the line, the row is better"
    )


def speed_plot(table: Table, report: BenchmarkReport) -> Panel | None:
    """Error over real-time factor."""
    del report
    column = main_column(table)
    rows = [(row, row.cost.factor) for row in table.rows if row.cost.factor and column in row.scores]
    points = [(factor, row.scores[column].mean) for row, factor in rows if factor is not None]
    if len(points) < 2:
        return None
    across = ends([x for x, _ in points], log=True)
    axes = Axes(across, ends([y for _, y in points]), ("real-time factor", column), log=True)
    for number, ((row, _), point) in enumerate(zip(rows, points, strict=True)):
        axes.dots([point], number, row.label)
    return Panel(axes.svg(), f"{column} over seconds of computing for a second of speech; lower left is better")
