"""How takes are written, whatever the format."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Up = Literal["y", "z"]


@dataclass(frozen=True)
class ExportOptions:
    """Choices of a user; a format looks at those that concern it.

    Attributes:
        unit: unit of length to convert to, as :func:`facediff.takes.metres_per_unit` takes it; None for what the
            format prescribes (metres in glTF), else the take's own.
        up: the axis that points up in the file; None for what the format prescribes, else y, which takes have up.
        speech: write the take's sound beside the animation, where the file cannot hold it.
        view: camera of a video: ``front``, ``three_quarter`` or ``side``.
        size: height and width of a video's panels in pixels.
        shapes: the set of shapes that weights are solved for: a folder of meshes, or a glb with named targets.
        tolerance_mm: how far a compressed mesh may lie from the vertices, in millimetres.
        footer: text under a video, such as "synthetic corpus".
        quiet: no progress bars.
    """

    unit: str | None = None
    up: Up | None = None
    speech: bool = True
    view: str = "front"
    size: int = 512
    shapes: Path | None = None
    tolerance_mm: float = 0.05
    footer: str = ""
    quiet: bool = True
