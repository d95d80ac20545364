"""One page that plays takes with their speech in any browser."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from facediff.animation import Animation
from facediff.export.format import ExportOptions, Format


def write(path: Path, takes: Sequence[Animation], options: ExportOptions, sound: str | None) -> None:
    """Write an .html file; several takes are shown next to each other."""
    from facediff.export.viewer import write_page

    write_page(path, [animation if options.speech else replace(animation, speech=None) for animation in takes])


FORMAT = Format(
    help="a page that plays in any browser, without a server",
    write=write,
    then="open it in a browser; `facediff view` has more options",
    several=True,
    holds_sound=True,
    unit="none",
    ups=(),
)
