"""The options of tracking faces in videos."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

from facediff.errors import FaceDiffError
from facediff.utils import ranges
from facediff.utils.option import Option

VARIABLE = "FACEDIFF_FACE_MODEL"
"""Environment variable with the path of the model."""


def check_face(face: str | None) -> None:
    """Refuse a choice of a face that is not known."""
    if face not in (None, "largest", "left") and not (face.isdecimal() and int(face) > 0):
        raise FaceDiffError(f"--face {face}: expected largest, left, or a number from the left, from 1")


@dataclass(frozen=True)
class TrackingOptions:
    """Tracking faces in videos.

    Attributes:
        model: Google's face_landmarker.task (default: named by the environment variable FACEDIFF_FACE_MODEL)
        frame_rate: frames a second of the corpus
        face: which of several faces: largest, left, or its number from the left
        min_face: width in pixels of the smallest face
        smoothing: of the motion, by region; or none
        scale: size of the faces: as the model's canonical face, or so that irises measure 11.7 mm
        clip_seconds: approximate length of a clip
        licence: terms of the footage, such as CC-BY-4.0 or "consent of Maria"; those of earlier runs stay beside them
        commercial: the terms allow commercial use
    """

    model: Annotated[Path | None, Option(metavar="TASK", reads=True)] = None
    frame_rate: Annotated[ranges.FrameRate, Option(metavar="F")] = 25.0
    face: Annotated[str | None, Option(metavar="WHICH", check=check_face)] = None
    min_face: Annotated[ranges.Pixels, Option(metavar="PIXELS")] = 50
    smoothing: Literal["region", "none"] = "region"
    scale: Literal["canonical", "iris"] = "canonical"
    clip_seconds: Annotated[ranges.ClipLength, Option(metavar="S")] = 8.0
    licence: Annotated[str, Option(metavar="TEXT")] = "unknown"
    commercial: bool = False

    @property
    def settings(self) -> dict[str, Any]:
        """What all people of a corpus have in common."""
        names = ("frame_rate", "smoothing", "scale", "clip_seconds")
        return {f"--{name.replace('_', '-')}": getattr(self, name) for name in names}

    @property
    def task(self) -> Path | None:
        """The file of the model."""
        path = os.environ.get(VARIABLE)
        return self.model or (Path(path).expanduser() if path else None)
