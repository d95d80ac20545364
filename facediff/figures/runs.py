"""The numbers behind training curves: the scalars that runs logged to metrics.csv."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from facediff.errors import FaceDiffError, choices
from facediff.figures.material import Array

METRICS = "metrics.csv"
AXES = ("step", "epoch")
Axis = Literal["step", "epoch"]


@dataclass(frozen=True)
class Curve:
    """One scalar of one run.

    Attributes:
        at: steps or epochs (N,).
        values: the scalar (N,), as logged: NaN or infinity where training diverged.
    """

    at: Array
    values: Array


def find_metrics(run: Path) -> Path:
    """The ``metrics.csv`` of a run folder, or the file itself.

    Raises:
        FaceDiffError: if there is none; naming runs below the folder, if there are.
    """
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
        axis: what the scalars are given over.

    Raises:
        FaceDiffError: if the file is damaged or has no scalar.
    """
    columns: dict[str, list[tuple[float, float]]] = {}
    try:
        with path.open(newline="", encoding="utf-8") as stream:
            epochs = _EpochsOfSteps()
            for row in csv.DictReader(stream):
                place = epochs.place(row, axis)
                for name, text in row.items():
                    if name not in (*AXES, None) and text not in ("", None) and place is not None:
                        columns.setdefault(name, []).append((place, float(text)))
    except (OSError, UnicodeDecodeError, csv.Error, ValueError, TypeError) as error:
        raise FaceDiffError(f"{path}: not readable as a table of numbers ({error})") from error
    if not columns:
        raise FaceDiffError(f"{path}: holds no scalar over {axis}s; expected what CSVLogger writes during training")
    # A run that was resumed may repeat steps: the later one counts.
    tables = {name: np.array(sorted(dict(points).items()), np.float64) for name, points in sorted(columns.items())}
    return {name: Curve(table[:, 0], table[:, 1]) for name, table in tables.items()}


class _EpochsOfSteps:
    """Tells where a row belongs; rows without an epoch (the learning rate's) belong to the one before."""

    def __init__(self) -> None:
        self.epoch: float | None = None

    def place(self, row: Mapping[str, str], axis: Axis) -> float | None:
        text = row.get(axis)
        if axis == "step":
            return float(text) if text else None
        if text:
            self.epoch = float(text)
        return self.epoch


def choose_scalars(runs: Mapping[str, Mapping[str, Curve]], wanted: Sequence[str] | None) -> list[str]:
    """Scalars to draw: those asked for, else the loss of training and the LVE of validation as far as they were logged.

    Raises:
        FaceDiffError: if a run has not logged a scalar, or none of the usual ones.
    """
    if wanted is None:
        usual = ("train/loss", "val/lve")
        wanted = [name for name in usual if all(name in curves for curves in runs.values())]
        if not wanted:
            common = dict.fromkeys(name for curves in runs.values() for name in curves)
            raise FaceDiffError(f"no run logged {', '.join(usual)}; choose with --scalar from {', '.join(common)}")
    for run, curves in runs.items():
        for name in wanted:
            if name not in curves:
                raise FaceDiffError(f'{run}: logged no scalar "{name}": {choices(name, curves)}')
    return list(dict.fromkeys(wanted))


def find_gaps(runs: Mapping[str, Mapping[str, Curve]], scalars: Sequence[str], *, log: bool = False) -> list[str]:
    """Notes on values that a drawing cannot show: NaN and infinity, and on a logarithmic axis what is not above 0."""
    notes = []
    for scalar in scalars:
        for run, curves in runs.items():
            values = curves[scalar].values
            shown = np.isfinite(values) & ((values > 0) | (not log))
            if not shown.all():
                what = "NaN, infinity or not above 0" if log else "NaN or infinity"
                notes.append(f"{run}: {(~shown).sum()} of {len(values)} values of {scalar} are {what} and not drawn")
    return notes


def smooth(values: Array, weight: float) -> Array:
    """Exponential moving average with weight w of the past, divided by the weights' sum (as Adam corrects its moments).

    s_n = Σ_k w^(n−k) x_k / Σ_k w^(n−k); values that are not finite are passed over and stay as they are.

    Args:
        values: (N,).
        weight: 0 leaves them as they are; below 1.
    """
    smoothed = np.array(values, np.float64)
    total = weights = 0.0
    for place, value in enumerate(values):
        if math.isfinite(value):
            total, weights = weight * total + (1 - weight) * value, weight * weights + (1 - weight)
            smoothed[place] = total / weights
    return smoothed
