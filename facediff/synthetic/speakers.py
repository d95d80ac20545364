"""The eight speakers: a face, a voice and a speaking style each. Their numbers are in ``speakers.toml``."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass
from importlib import resources
from typing import Any

from facediff.synthetic.motion import SpeakingStyle
from facediff.synthetic.rig import Shape
from facediff.synthetic.speech import Voice


@dataclass(frozen=True)
class Speaker:
    """One of the corpus's speakers."""

    name: str  # Identity, such as `"F1"`
    voice: Voice  # How espeak-ng speaks for them
    shape: Shape  # How their head differs from the neutral one
    style: SpeakingStyle  # How their face moves


def _read_speakers() -> dict[str, Speaker]:
    text = resources.files(__package__).joinpath("speakers.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, dict[str, Any]]] = tomllib.loads(text)
    # The constructors refuse a number that they do not know, so a misspelt name cannot go unnoticed.
    return {
        name: Speaker(name, Voice(**table["voice"]), Shape(**table["shape"]), SpeakingStyle(**table["style"]))
        for name, table in tables.items()
    }


SPEAKERS = _read_speakers()
