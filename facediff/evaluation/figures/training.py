"""The figure of training: logged scalars of one or more runs over steps or epochs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from facediff.errors import FaceDiffError, check_known
from facediff.evaluation.figures.material import Array
from facediff.evaluation.figures.page import PANEL_HEIGHT, Paper, check_output, legend_columns, new_figure, save, style
from facediff.reporting.drawing import SMALLEST_TEXT, line_style, plain
from facediff.utils import ranges
from facediff.utils.plain_files import read_rows

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Axis = Literal["step", "epoch"]
METRICS = "metrics.csv"
USUAL_SCALARS = ("train/loss", "val/lve")

NARROW = 120.0  # Width in mm below which all panels are in one column
FEW_POINTS = 12  # Up to this many values of a curve, each is marked and none is smoothed


@dataclass(frozen=True)
class Curve:
    """One scalar of one run."""

    at: Array  # steps or epochs (N,)
    values: Array  # (N,), as logged: NaN or infinity where training diverged


def find_metrics(run: Path) -> Path:
    """The ``metrics.csv`` of a run folder, or the file itself."""
    path = run if run.name.endswith(".csv") else run / METRICS
    if path.is_file():
        return path
    below = sorted(run.glob(f"*/{METRICS}")) or sorted(run.glob(f"*/*/{METRICS}"))
    advice = (
        f"runs below are {', '.join(str(file.parent) for file in below)}"
        if below
        else "expected a run folder written by `facediff fit`, such as runs/puppet/version_0"
    )
    raise FaceDiffError(f"{path}: no such file; {advice}")


def read_curves(path: Path, axis: Axis = "step") -> dict[str, Curve]:
    """Every scalar of a run, as Lightning's CSVLogger writes them: one column each, empty where it was not logged.

    Args:
        path: ``metrics.csv``.
        axis: of the scalars.
    """
    # The inner dictionaries are by step or epoch: a run that was resumed may repeat steps, and the later one counts.
    columns: dict[str, dict[float, float]] = {}
    try:
        x: str | None = None
        for row in read_rows(path, remedy="expected a metrics.csv of CSVLogger"):
            # Rows of the learning rate have no epoch: they belong to the epoch of the row before.
            x = row.get(axis) or (x if axis == "epoch" else None)
            for name, text in row.items():
                if name not in ("step", "epoch", "") and text and x and np.isfinite(float(x)):
                    columns.setdefault(name, {})[float(x)] = float(text)
    except ValueError:
        columns = {}
    if not columns:
        raise FaceDiffError(f"{path}: holds no numbers over {axis}s; expected a metrics.csv of CSVLogger")
    tables = {name: np.array(sorted(points.items()), np.float64) for name, points in sorted(columns.items())}
    return {name: Curve(table[:, 0], table[:, 1]) for name, table in tables.items()}


def choose_scalars(runs: Mapping[str, Mapping[str, Curve]], scalars: Sequence[str] | None) -> list[str]:
    """Scalars to draw: the given ones, else the loss of training and the LVE of validation if they were logged."""
    defaults = [name for name in USUAL_SCALARS if all(name in curves for curves in runs.values())]
    scalars = scalars or defaults or USUAL_SCALARS
    for run, curves in runs.items():
        check_known(f"--scalar: {run}", "scalar", scalars, curves)
    return list(dict.fromkeys(scalars))


def find_gaps(runs: Mapping[str, Mapping[str, Curve]], scalars: Sequence[str], *, log: bool = False) -> list[str]:
    """Notes on values that a drawing cannot show: NaN and infinity, and on a logarithmic axis values not above 0."""
    notes = []
    for scalar in scalars:
        for run, curves in runs.items():
            values = curves[scalar].values
            drawable = np.isfinite(values) & ((values > 0) | (not log))
            if not drawable.all():
                kind = "NaN, infinity or not above 0" if log else "NaN or infinity"
                notes.append(f"{run}: {(~drawable).sum()} of {len(values)} values of {scalar} are {kind} and not drawn")
    return notes


def smooth(values: Array, weight: float) -> Array:
    """Exponential moving average with weight w of the past, divided by the weights' sum (as Adam corrects its moments).

    s_n = Σ_k w^(n−k) x_k / Σ_k w^(n−k); values that are not finite are skipped and stay as they are.

    Args:
        values: (N,).
        weight: 0 leaves them as they are; below 1.
    """
    smoothed = np.array(values, np.float64)
    total = weights = 0.0
    for index, value in enumerate(values):
        if math.isfinite(value):
            total, weights = weight * total + (1 - weight) * value, weight * weights + (1 - weight)
            smoothed[index] = total / weights
    return smoothed


@ranges.checked
def draw_training(
    runs: Mapping[str, Mapping[str, Curve]],
    scalars: Sequence[str],
    output: Path,
    *,
    paper: Paper | None = None,
    axis: Axis = "step",
    smoothing: ranges.Smoothing = 0.0,
    log: bool = False,
) -> None:
    """Draw scalars over training, a panel each, all runs in one panel.

    Args:
        runs: curves by scalar, by run.
        scalars: scalars to draw.
        output: ``.png``, ``.pdf`` or ``.svg``.
        paper: width, resolution and font.
        axis: horizontal axis.
        smoothing: weight of the past in the moving average, from 0 (none) to below 1; the values themselves stay
            visible behind it.
        log: whether the values' axis is logarithmic.
    """
    check_output(output)
    paper = paper or Paper()
    across = 1 if paper.width < NARROW else {1: 1, 2: 2, 4: 2}.get(len(scalars), 3)
    down = -(-len(scalars) // across)
    with style(paper):
        legend = 6.0 * (len(runs) > 1)
        figure = new_figure(paper, (PANEL_HEIGHT + 10) * down + legend, layout="constrained")
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for panel in panels[len(scalars) :]:
            panel.set_axis_off()
        for panel, scalar in zip(panels, scalars, strict=False):
            for number, (run, curves) in enumerate(runs.items()):
                _draw_curve(panel, run, curves[scalar], number, smoothing, log=log)
            if log:
                _log_scale(panel)
            panel.set_xlabel(axis)
            panel.set_ylabel(plain(scalar))
        at = np.concatenate([curves[scalar].at for curves in runs.values() for scalar in scalars])
        for panel in panels[: len(scalars)]:
            panel.set_xlim(at.min() - 0.01 * np.ptp(at) - 1e-9, at.max() + 0.01 * np.ptp(at) + 1e-9)
        if len(runs) > 1:
            handles, labels = panels[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper center", ncols=legend_columns(panels[0], paper))
        save(figure, output)


def _draw_curve(panel: Axes, run: str, curve: Curve, number: int, smoothing: float, *, log: bool) -> None:
    look = line_style(number)
    values = np.where(curve.values > 0, curve.values, np.nan) if log else curve.values
    marker = {"marker": "o", "markersize": 2.5} if len(values) <= FEW_POINTS else {}
    if smoothing and len(values) > FEW_POINTS:
        panel.plot(curve.at, values, color=look["color"], alpha=0.25, linewidth=0.6)
        values = smooth(values, smoothing)
    panel.plot(curve.at, values, label=plain(run), **look, **marker)  # type: ignore[arg-type]


def _log_scale(panel: Axes) -> None:
    from matplotlib.ticker import LogFormatter, NullFormatter

    panel.set_yscale("log")
    low, high = panel.get_ylim()
    panel.yaxis.set_major_formatter(LogFormatter())
    # With less than a decade in view the powers of ten alone would leave the axis without numbers.
    panel.yaxis.set_minor_formatter(LogFormatter(minor_thresholds=(1.5, 0.6)) if high < 30 * low else NullFormatter())
    panel.tick_params(axis="y", which="minor", labelsize=SMALLEST_TEXT)
