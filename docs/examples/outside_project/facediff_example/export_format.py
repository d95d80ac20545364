"""An export format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from facediff.animation import Animation
from facediff.export import ExportOptions, Format
from facediff.export.format import FileSpace


class Bounds(Format):
    """Text: the box around the vertices of every frame."""

    def write(self, path: Path, animations: Sequence[Animation], options: ExportOptions) -> None:
        """One line a frame: the smallest x, y, z, then the largest."""
        (animation,) = animations
        frames = FileSpace.of(animation, options).frames(animation)
        boxes = ((*vertices.min(0), *vertices.max(0)) for vertices in frames)
        path.write_text("".join(" ".join(f"{value:.6g}" for value in box) + "\n" for box in boxes))
