"""Figures of curves over time and over training: the mouth's opening above the sound, and logged scalars."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.figures.lips import Curves, envelope
from facediff.figures.material import TRUTH
from facediff.figures.page import (
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
from facediff.figures.phonemes import BILABIALS, Phoneme
from facediff.figures.runs import Axis, Curve, smooth

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

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
