"""The figure of the mouth's opening over time, with phonemes and waveform beneath."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch

from facediff.errors import FaceDiffError
from facediff.evaluation.figures.material import TRUTH, Array, FigureData, chunks, shortest
from facediff.evaluation.figures.page import (
    BLACK,
    FAINT,
    GREY,
    PANEL_HEIGHT,
    SMALLEST_TEXT,
    Paper,
    check_output,
    legend_columns,
    line_style,
    new_figure,
    plain,
    save,
    style,
    text_width,
)
from facediff.metrics import LipPairs
from facediff.metrics.mouth import opening
from facediff.speech.phonemes import TimedPhoneme, closed_times
from facediff.utils import SAMPLE_RATE, ranges

if TYPE_CHECKING:
    from matplotlib.axes import Axes


@dataclass(frozen=True)
class Curves:
    """The opening of the mouth."""

    times: Array  # middle of each frame (T,), in seconds
    openings: dict[str, Array]  # opening (T,) by name, the truth's first, in the vertices' unit


@dataclass(frozen=True)
class SpeechTrack:
    """The speech of a clip."""

    # Speech (S,); empty if there is none.
    samples: npt.NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))
    sample_rate: int = SAMPLE_RATE
    phonemes: Sequence[TimedPhoneme] = ()  # phonemes in time; empty if they are not known


def opening_curves(material: FigureData, clip: str, pairs: LipPairs) -> tuple[Curves, str | None]:
    """The opening of truth and methods in a clip: the mean distance of the pairs, as in `MouthOpeningDifference`.

    Returns:
        the curves in the common length; and a note if lengths differ.
    """
    motions = material.open(clip)
    frames, note = shortest(motions)
    indices = pairs.tensor()
    openings = {
        name: np.concatenate(
            [
                opening(torch.from_numpy(part), None, indices).numpy()
                for part in chunks(motion, material.path(clip, name), frames)
            ]
        )
        for name, motion in motions.items()
    }
    return Curves(np.asarray((np.arange(frames) + 0.5) / material.rate, np.float64), openings), note


def envelope(samples: npt.NDArray[np.float32], columns: int) -> tuple[Array, Array]:
    """Lowest and highest sample of each of up to ``columns`` equal stretches, so that a waveform stays a small drawing.

    Returns:
        lowest and highest, (columns,) each, or fewer if there are fewer samples.
    """
    edges = np.linspace(0, len(samples), min(columns, len(samples)) + 1).astype(np.int64)
    low, high = (np.asarray(f.reduceat(samples, edges[:-1]), np.float64) for f in (np.minimum, np.maximum))
    return low, high


@ranges.checked
def draw_lips(
    curves: Curves,
    sound: SpeechTrack,
    output: Path,
    *,
    paper: Paper | None = None,
    scale: tuple[float, str] = (1.0, "unit of the vertices"),
    span: tuple[ranges.Seconds, ranges.Seconds] | None = None,
    remark: str = "",
) -> None:
    """Draw the opening of the mouth of truth and methods, with phonemes and waveform beneath.

    ``scale`` has the factor of the openings and the resulting unit, ``span`` the first and the last second.
    """
    check_output(output)
    paper = paper or Paper()
    low, high = _span(curves, span)
    parts = [1.0, *([0.13] if sound.phonemes else []), *([0.42] if sound.samples.size else [])]
    with style(paper):
        figure = new_figure(paper, PANEL_HEIGHT * sum(parts) + 16 + 3.5 * bool(remark), layout="constrained")
        figure.get_layout_engine().set(hspace=0.02, h_pad=0.03, w_pad=0.03)  # type: ignore[union-attr, call-arg]
        axes = figure.subplots(len(parts), 1, sharex=True, height_ratios=parts, squeeze=False)[:, 0]
        methods = [name for name in curves.openings if name != TRUTH]
        for name, values in curves.openings.items():
            look = {"color": BLACK, "linewidth": 1.6} if name == TRUTH else line_style(methods.index(name))
            axes[0].plot(curves.times, values * scale[0], label=plain(name), **look)
        axes[0].set_ylabel(plain(f"lip opening [{scale[1]}]"))
        axes[0].set_ylim(bottom=min(0.0, axes[0].get_ylim()[0]))
        rest = list(axes[1:])
        if sound.phonemes:
            # Grey where the lips close in speech: a good method's curve is low there.
            label: str | None = "/p/, /b/, /m/"
            for start, end in closed_times(sound.phonemes):
                axes[0].axvspan(start, end, color=FAINT, alpha=0.45, linewidth=0, label=label, zorder=0)
                label = None
            _draw_phonemes(rest.pop(0), sound.phonemes, (low, high), paper)
        if sound.samples.size:
            _draw_waveform(rest[0], sound, (low, high), paper)
        figure.legend(loc="outside upper center", ncols=legend_columns(axes[0], paper))
        axes[-1].set_xlim(low, high)
        axes[-1].set_xlabel("time [s]")
        for panel in axes[:-1]:
            panel.tick_params(axis="x", bottom=False, labelbottom=False)
        if remark:
            figure.supxlabel(plain(remark), size=SMALLEST_TEXT, color=GREY, x=0.99, ha="right")
        save(figure, output)


def _span(curves: Curves, span: tuple[float, float] | None) -> tuple[float, float]:
    end = float(curves.times[-1] + curves.times[0])  # the first frame's middle is half a frame
    if span is None:
        return 0.0, end
    if not ((span[0] <= curves.times) & (curves.times <= span[1])).any():
        raise FaceDiffError(f"--span {span[0]:g} {span[1]:g}: holds no frame; expected two times between 0 and {end:g}")
    return span[0], min(span[1], end)


def _draw_phonemes(axes: Axes, phonemes: Sequence[TimedPhoneme], span: tuple[float, float], paper: Paper) -> None:
    """Phonemes at their places on two levels in turn; one that would overlap its neighbour is left out."""
    axes.set_axis_off()
    axes.set_ylim(0, 1)
    mm_per_second = (paper.width - 15) / (span[1] - span[0])
    ends = [-np.inf, -np.inf]
    for phoneme in phonemes:
        if not phoneme.ipa or not span[0] <= phoneme.middle <= span[1]:
            continue
        half = text_width(phoneme.plain, SMALLEST_TEXT, paper.font) / 2 / mm_per_second
        level = next((k for k in (0, 1) if phoneme.middle - half >= ends[k]), None)
        if level is None:
            continue
        ends[level] = phoneme.middle + half + 0.8 / mm_per_second
        axes.text(phoneme.middle, (0.75, 0.2)[level], phoneme.plain, size=SMALLEST_TEXT, ha="center", va="center")


def _draw_waveform(axes: Axes, sound: SpeechTrack, span: tuple[float, float], paper: Paper) -> None:
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
