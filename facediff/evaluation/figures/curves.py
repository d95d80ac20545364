"""Figures of curves over time and over training: the mouth's opening above the sound, and logged scalars."""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import numpy.typing as npt
import torch

from facediff.data.phonemes import BILABIALS, Phoneme
from facediff.errors import FaceDiffError, choices
from facediff.evaluation.figures.material import TRUTH, Array, Material, chunks, shortest
from facediff.evaluation.figures.page import (
    BLACK,
    FAINT,
    GREY,
    LINES,
    POINTS_PER_MM,
    SMALLEST_TEXT,
    Paper,
    check_output,
    new_figure,
    plain,
    save,
    style,
    text_width,
)
from facediff.metrics import LipPairs
from facediff.metrics.mouth import opening

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# The numbers behind training curves: the scalars that runs logged to metrics.csv.

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


# The numbers behind lip curves: the mouth's opening over time, and the outline of a waveform.

PAIRS_FILE = "regions/inner_lip_pairs.txt"
"""Where a corpus has its pairs of inner-lip vertices."""


@dataclass(frozen=True)
class Curves:
    """The opening of the mouth.

    Attributes:
        times: middle of each frame (T,), in seconds.
        openings: opening (T,) by name, the truth's first, in the vertices' unit.
    """

    times: Array
    openings: dict[str, Array]


def read_pairs(source: str | None, corpus: Path | None, n_vertices: int) -> LipPairs:
    """Pairs of an upper and a lower lip vertex.

    Args:
        source: a text file of pairs, or pairs themselves, ``3531-3504,1-2``; the corpus's file if None.
        corpus: the corpus folder.
        n_vertices: vertices of the mesh.

    Raises:
        FaceDiffError: if nothing says them, or they are none of this mesh.
    """
    if source is None and corpus is not None and (corpus / PAIRS_FILE).is_file():
        source = str(corpus / PAIRS_FILE)
    if source is None:
        where = f"{corpus / PAIRS_FILE}: no such file" if corpus is not None else "the truth is no corpus folder"
        raise FaceDiffError(
            f"{where}; give --lip-pairs, a file with one upper and one lower lip vertex a line, or pairs such as "
            f"3531-3504 (the middle of FLAME's lips)"
        )
    try:
        if not Path(source).is_file() and all(c.isdecimal() or c in "-," for c in source):
            pairs = LipPairs.from_pairs("given", [[int(i) for i in pair.split("-")] for pair in source.split(",")])
        else:
            pairs = LipPairs.from_file(source)
        pairs.check(n_vertices)
    except ValueError as error:
        raise FaceDiffError(f"--lip-pairs {source}: {error}") from error
    return pairs


def opening_curves(material: Material, clip: str, pairs: LipPairs) -> tuple[Curves, str | None]:
    """The opening of truth and methods in a clip: the mean distance of the pairs, as `MouthOpeningDifference` has it.

    Returns:
        the curves in the length that all have; and a note if lengths differ.

    Raises:
        FaceDiffError: if a file cannot be used.
    """
    motions = material.open(clip)
    frames, note = shortest(motions)
    indices, openings = pairs.tensor(), {}
    for name, motion in motions.items():
        found = np.empty(frames)
        for first, part in chunks(motion, material.path(clip, name), frames):
            found[first : first + len(part)] = opening(torch.from_numpy(part), None, indices).numpy()
        openings[name] = found
    return Curves(np.asarray((np.arange(frames) + 0.5) / material.rate, np.float64), openings), note


def envelope(samples: npt.NDArray[np.float32], columns: int) -> tuple[Array, Array]:
    """Lowest and highest sample of each of up to ``columns`` equal stretches, so that a waveform stays a small drawing.

    Returns:
        lowest and highest, (columns,) each, or fewer if there are fewer samples.
    """
    edges = np.linspace(0, len(samples), min(columns, len(samples)) + 1).astype(np.int64)
    low, high = (np.asarray(f.reduceat(samples, edges[:-1]), np.float64) for f in (np.minimum, np.maximum))
    return low, high


PANEL = 42.0
"""Height of an axes in mm."""

NARROW = 120.0
"""Width in mm below which panels stand below one another."""


FEW_POINTS = 12
"""Values of a curve up to which each is marked and none is smoothed."""


@dataclass(frozen=True)
class Sound:
    """What is heard in a clip.

    Attributes:
        samples: speech (S,); empty if there is none.
        sample_rate: samples a second.
        phonemes: phonemes in time; empty if they are not known.
    """

    samples: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    sample_rate: int = 16_000
    phonemes: Sequence[Phoneme] = ()


def draw_lips(
    curves: Curves,
    sound: Sound,
    output: Path,
    *,
    paper: Paper | None = None,
    scale: tuple[float, str] = (1.0, "unit of the vertices"),
    span: tuple[float, float] | None = None,
    remark: str = "",
) -> None:
    """Draw the opening of the mouth of truth and methods, with phonemes and waveform beneath.

    Args:
        curves: the openings.
        sound: what is heard.
        output: ``.png``, ``.pdf`` or ``.svg``.
        paper: width, resolution and font.
        scale: what openings are multiplied with, and the unit that gives.
        span: first and last second; the whole clip if None.
        remark: small text below everything.

    Raises:
        FaceDiffError: if the span has no frame in it.
    """
    check_output(output)
    paper = paper or Paper()
    low, high = _span(curves, span)
    parts = [1.0, *([0.13] if sound.phonemes else []), *([0.42] if sound.samples.size else [])]
    with style(paper):
        figure = new_figure(paper, PANEL * sum(parts) + 16 + 3.5 * bool(remark), layout="constrained")
        figure.get_layout_engine().set(hspace=0.02, h_pad=0.03, w_pad=0.03)  # type: ignore[union-attr, call-arg]
        axes = figure.subplots(len(parts), 1, sharex=True, height_ratios=parts, squeeze=False)[:, 0]
        _openings(axes[0], curves, scale)
        rest = list(axes[1:])
        if sound.phonemes:
            _closures(axes[0], sound.phonemes)
            strip = rest.pop(0)
            _phonemes(strip, sound.phonemes, (low, high), (paper.width - 15) / (high - low), paper.font)
        if sound.samples.size:
            _waveform(rest[0], sound, (low, high), paper)
        figure.legend(loc="outside upper center", ncols=_legend_columns(axes[0], paper))
        axes[-1].set_xlim(low, high)
        axes[-1].set_xlabel("time [s]")
        for each in axes[:-1]:
            each.tick_params(axis="x", bottom=False, labelbottom=False)
        _remark(figure, remark)
        save(figure, output)


def draw_training(
    runs: Mapping[str, Mapping[str, Curve]],
    scalars: Sequence[str],
    output: Path,
    *,
    paper: Paper | None = None,
    axis: Axis = "step",
    smoothing: float = 0.0,
    log: bool = False,
) -> None:
    """Draw scalars over training, a panel each, all runs in one panel.

    Args:
        runs: curves by scalar, by run.
        scalars: scalars to draw.
        output: ``.png``, ``.pdf`` or ``.svg``.
        paper: width, resolution and font.
        axis: what the curves are over.
        smoothing: weight of the past in the moving average, from 0 (none) to below 1; the values themselves stay
            visible behind it.
        log: whether the values' axis is logarithmic.

    Raises:
        FaceDiffError: if the smoothing is out of range, or a logarithmic axis has nothing above 0 to show.
    """
    check_output(output)
    if not 0 <= smoothing < 1:
        raise FaceDiffError(f"--smooth {smoothing:g}: expected a number from 0 to below 1, e.g. 0.9")
    paper = paper or Paper()
    across = 1 if paper.width < NARROW else {1: 1, 2: 2, 4: 2}.get(len(scalars), 3)
    down = -(-len(scalars) // across)
    with style(paper):
        legend = 6.0 * (len(runs) > 1)
        figure = new_figure(paper, (PANEL + 10) * down + legend, layout="constrained")
        panels = figure.subplots(down, across, squeeze=False).ravel()
        for panel in panels[len(scalars) :]:
            panel.set_axis_off()
        for panel, scalar in zip(panels, scalars, strict=False):
            for number, (run, curves) in enumerate(runs.items()):
                _training(panel, run, curves[scalar], number, smoothing, log=log)
            if log and not any((curves[scalar].values > 0).any() for curves in runs.values()):
                raise FaceDiffError(f'"{scalar}" has no value above 0, which --log needs; leave the option away')
            if log:
                _log_scale(panel)
            panel.set_xlabel(axis)
            panel.set_ylabel(plain(scalar))
        at = np.concatenate([curves[scalar].at for curves in runs.values() for scalar in scalars])
        for panel in panels[: len(scalars)]:
            panel.set_xlim(at.min() - 0.01 * np.ptp(at) - 1e-9, at.max() + 0.01 * np.ptp(at) + 1e-9)
        if len(runs) > 1:
            figure.legend(
                *panels[0].get_legend_handles_labels(),
                loc="outside upper center",
                ncols=_legend_columns(panels[0], paper),
            )
        save(figure, output)


def line_style(number: int) -> dict[str, object]:
    """Colour, dashes and width of a method's or run's line, as matplotlib's options."""
    colour, dashes = LINES[number % len(LINES)]
    return {"color": colour, "linestyle": dashes, "linewidth": 1.1 if number < len(LINES) else 0.7}


def _span(curves: Curves, span: tuple[float, float] | None) -> tuple[float, float]:
    half = float(curves.times[0])  # the first frame's middle
    whole = (0.0, float(curves.times[-1]) + half)
    if span is None:
        return whole
    if not (0 <= span[0] < span[1] and span[0] < whole[1]):
        raise FaceDiffError(f"--span {span[0]:g} {span[1]:g}: expected two times in order, between 0 and {whole[1]:g}")
    if not ((span[0] <= curves.times) & (curves.times <= span[1])).any():
        raise FaceDiffError(f"--span {span[0]:g} {span[1]:g}: the middle of no frame lies in it; make it longer")
    return span[0], min(span[1], whole[1])


def _openings(axes: Axes, curves: Curves, scale: tuple[float, str]) -> None:
    methods = [name for name in curves.openings if name != TRUTH]
    for name, values in curves.openings.items():
        look = {"color": BLACK, "linewidth": 1.6} if name == TRUTH else line_style(methods.index(name))
        axes.plot(curves.times, values * scale[0], label=plain(name), **look)  # type: ignore[arg-type]
    axes.set_ylabel(plain(f"lip opening [{scale[1]}]"))
    axes.set_ylim(bottom=min(0.0, axes.get_ylim()[0]))


def _closures(axes: Axes, phonemes: Sequence[Phoneme]) -> None:
    """Grey where the lips close in speech: a good method's curve is low there."""
    label: str | None = ", ".join(f"/{each}/" for each in BILABIALS)
    for phoneme in phonemes:
        if phoneme.plain in BILABIALS:
            axes.axvspan(phoneme.start, phoneme.end, color=FAINT, alpha=0.45, linewidth=0, label=label, zorder=0)
            label = None


def _phonemes(
    axes: Axes, phonemes: Sequence[Phoneme], span: tuple[float, float], mm_per_second: float, font: str
) -> None:
    """Phonemes at their places on two levels in turn; one that would run into its neighbour is left out."""
    axes.set_axis_off()
    axes.set_ylim(0, 1)
    ends = [-np.inf, -np.inf]
    for phoneme in phonemes:
        if not phoneme.ipa or not span[0] <= phoneme.middle <= span[1]:
            continue
        half = text_width(phoneme.plain, SMALLEST_TEXT, font) / 2 / mm_per_second
        level = next((k for k in (0, 1) if phoneme.middle - half >= ends[k]), None)
        if level is None:
            continue
        ends[level] = phoneme.middle + half + 0.8 / mm_per_second
        axes.text(phoneme.middle, (0.75, 0.2)[level], phoneme.plain, size=SMALLEST_TEXT, ha="center", va="center")


def _waveform(axes: Axes, sound: Sound, span: tuple[float, float], paper: Paper) -> None:
    first, last = (round(second * sound.sample_rate) for second in span)
    low, high = envelope(sound.samples[first:last], min(paper.pixels(paper.width) // 2, 1000))
    stop = min(last, sound.samples.size) / sound.sample_rate
    edges = np.linspace(span[0], max(stop, span[0]), len(low) + 1)
    axes.fill_between((edges[:-1] + edges[1:]) / 2, low, high, color=GREY, linewidth=0.3)
    largest = max(float(np.abs(sound.samples).max()), 1e-6)
    axes.set_ylim(-1.05 * largest, 1.05 * largest)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_ylabel("sound")


def _training(panel: Axes, run: str, curve: Curve, number: int, smoothing: float, *, log: bool) -> None:
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


def _legend_columns(axes: Axes, paper: Paper) -> int:
    """As many entries a line as surely fit."""
    labels = axes.get_legend_handles_labels()[1]
    font_size = axes.xaxis.label.get_fontproperties().get_size_in_points()
    widest = max(text_width(label, font_size, paper.font) for label in labels)
    entry = widest + (2.6 + 0.8 + 2.0) * font_size / POINTS_PER_MM
    return max(1, min(len(labels), int((paper.width - 2) / entry)))


def _remark(figure: Figure, remark: str) -> None:
    if remark:
        figure.supxlabel(plain(remark), size=SMALLEST_TEXT, color=GREY, x=0.99, ha="right")
