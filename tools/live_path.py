"""Draw the path of a live performance, and where its milliseconds go, as an SVG.

    python tools/live_path.py docs/images/live_path.svg --computing 32

Look-ahead and hop are those of the window plans; milliseconds of computing are what `facediff live` reports as the
median of a window on the machine in question.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from facediff.live.timing import MARGIN
from facediff.speech.resampling import Resampler
from facediff.speech.windows import LOW_LATENCY, WindowPlan

WIDTH, LEFT, RIGHT = 1000, 40, 960
TEXT, QUIET, LINE = "#223", "#334", "#556"
BLUE, GREEN, YELLOW, PURPLE, RED, GREY = "#dfe9f5", "#e3eedd", "#f6ead2", "#efe3ef", "#f3dcd8", "#e8e8e8"


@dataclass(frozen=True)
class Part:
    """A part of the lag: what it is called, its milliseconds and its colour."""

    name: str
    milliseconds: float
    colour: str


def parts_of(plan: WindowPlan, rate: float, computing: float, block: float = 10.0) -> list[Part]:
    """The parts of the lag of the first frame of a window, which waits longest and decides for all."""
    frames = plan.in_frames(rate)
    return [
        Part("block of the sound device", block, BLUE),
        Part("resampling", 1000 * Resampler(48_000, 16_000).delay, GREY),
        Part("rest of the window", 1000 * (frames.frames - 1) / rate, YELLOW),
        Part("speech after it", 1000 * frames.after / rate, PURPLE),
        Part("computing", computing, RED),
        Part("margin until it is due", 1500 * MARGIN, GREEN),
        Part("weights and sending", 1.5, BLUE),
    ]


def box(x: float, y: float, width: float, name: str, lines: Sequence[str], colour: str) -> Iterator[str]:
    """A box with a name and further lines."""
    height = 34 + 17 * len(lines)
    yield f'<rect x="{x:g}" y="{y:g}" width="{width:g}" height="{height:g}" rx="8" fill="{colour}" stroke="{LINE}"/>'
    middle = x + width / 2
    yield text(middle, y + 23, name, 15, TEXT, bold=True)
    for place, line in enumerate(lines):
        yield text(middle, y + 43 + 17 * place, line, 12, QUIET)


def text(x: float, y: float, words: str, size: int, colour: str, *, bold: bool = False, anchor: str = "middle") -> str:
    """A line of text."""
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" font-size="{size}"{weight} fill="{colour}">'
        f"{escape(words)}</text>"
    )


def bar(y: float, title: str, parts: Sequence[Part]) -> Iterator[str]:
    """Parts of a lag to scale, with their names below."""
    total = sum(part.milliseconds for part in parts)
    yield text(LEFT, y, f"{title}: {total:.0f} ms", 15, TEXT, bold=True, anchor="start")
    scale, x = (RIGHT - LEFT) / total, float(LEFT)
    for part in parts:
        width = part.milliseconds * scale
        yield (
            f'<rect x="{x:.1f}" y="{y + 12:g}" width="{width:.1f}" height="30" fill="{part.colour}" stroke="{LINE}"/>'
        )
        if width > 150:
            yield text(x + width / 2, y + 32, f"{part.name} {part.milliseconds:.0f} ms", 12, QUIET)
        x += width
    shown = [part for part in parts if part.milliseconds * scale <= 150 and part.milliseconds]
    x = float(LEFT)
    for part in shown:
        yield f'<rect x="{x:.1f}" y="{y + 54:g}" width="12" height="12" fill="{part.colour}" stroke="{LINE}"/>'
        words = f"{part.name} {part.milliseconds:.3g} ms"
        yield text(x + 18, y + 65, words, 12, QUIET, anchor="start")
        x += 40 + 6.3 * len(words)


def picture(rate: float, computing: float, usual: float) -> str:
    """The whole picture."""
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} 400" width="{WIDTH}" height="400" '
        f'font-family="Helvetica, Arial, sans-serif">',
        '<rect width="100%" height="100%" fill="#ffffff"/>',
    ]
    stations = [
        ("source", ["microphone, recording,", "standard input"], BLUE),
        ("backlog", ["waits for the model;", "too much is dropped"], GREY),
        ("model", ["windows of speech", "to bursts of frames"], RED),
        ("pacer", ["each frame at its time;", "late ones are dropped"], GREEN),
        ("receivers", ["page, Live Link, VMC,", "OSC, JSON lines"], PURPLE),
    ]
    wide, gap = 160, 30
    for place, (name, about, colour) in enumerate(stations):
        x = LEFT + place * (wide + gap)
        lines += box(x, 50, wide, name, about, colour)
        if place:
            lines.append(f'<path d="M{x - gap + 4} 84 h{gap - 8} m-6 -5 l6 5 l-6 5" fill="none" stroke="{LINE}"/>')
    threads = [("a thread", 0, 0), ("a thread", 1, 2), ("the caller", 3, 4)]
    for name, first, last in threads:
        x, end = LEFT + first * (wide + gap), LEFT + last * (wide + gap) + wide
        lines.append(f'<path d="M{x} 40 v-8 h{end - x} v8" fill="none" stroke="{LINE}"/>')
        lines.append(text((x + end) / 2, 26, name, 12, QUIET))
    lines.append(text(LEFT, 152, "From a sample that is spoken to the packet that leaves", 13, QUIET, anchor="start"))
    lines += bar(185, f"low latency, as usual, {rate:g} frames a second", parts_of(LOW_LATENCY, rate, computing))
    short = WindowPlan().chosen(1.0, 0.4)
    lines += bar(285, "with --window 1 --overlap 0.4", parts_of(short, rate, usual))
    return "\n".join([*lines, "</svg>"]).replace('height="400"', 'height="370"').replace("1000 400", "1000 370") + "\n"


def main(arguments: Sequence[str] | None = None) -> None:
    """Write the picture."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--rate", type=float, default=25.0, help="frames a second (default: 25)")
    parser.add_argument("--computing", type=float, default=25.0, help="ms of a window at low latency")
    parser.add_argument("--usual", type=float, default=45.0, help="ms of a window of 1 s")
    options = parser.parse_args(arguments)
    options.output.write_text(picture(options.rate, options.computing, options.usual), encoding="utf-8")


if __name__ == "__main__":
    main()
