"""The eight speakers: a face, a voice and a speaking style each. Their numbers are in ``speakers.toml``.

Further speakers, :func:`drawn_speaker`, have random numbers, about those of the six that models are trained on.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np

from facediff.speech.espeak import EspeakVoice
from facediff.synthetic.motion import SpeakingStyle
from facediff.synthetic.rig import Shape


@dataclass(frozen=True)
class Speaker:
    """One of the corpus's speakers."""

    name: str  # Identity, such as `"F1"`
    voice: EspeakVoice  # How espeak-ng speaks for them
    shape: Shape  # How their head differs from the neutral one
    style: SpeakingStyle  # How their face moves


def _read_speakers() -> dict[str, Speaker]:
    text = resources.files(__package__).joinpath("speakers.toml").read_text(encoding="utf-8")
    tables: dict[str, dict[str, dict[str, Any]]] = tomllib.loads(text)
    # The constructors refuse unknown keywords, so a misspelt name cannot go unnoticed.
    return {
        name: Speaker(name, EspeakVoice(**table["voice"]), Shape(**table["shape"]), SpeakingStyle(**table["style"]))
        for name, table in tables.items()
    }


SPEAKERS = _read_speakers()

DRAWN = "X"
"""How names of drawn speakers start: ``X01``, ``X02`` …"""
MOST_DRAWN = 99
_VOICES = ("en-us", "en-gb-x-rp", "en-gb-scotland", "en")
_VARIANTS = ("f1", "f2", "f3", "f4", "f5", "m1", "m2", "m3", "m4", "m6", "m7")


def drawn_names(count: int) -> tuple[str, ...]:
    """Names of the first ``count`` drawn speakers."""
    return tuple(f"{DRAWN}{number:02d}" for number in range(1, count + 1))


def speaker_of(name: str) -> Speaker:
    """One of the eight, or a drawn speaker, by name."""
    return SPEAKERS[name] if name in SPEAKERS else drawn_speaker(int(name.removeprefix(DRAWN)))


@lru_cache(maxsize=MOST_DRAWN)
def drawn_speaker(number: int) -> Speaker:
    """A speaker with random voice, face and speaking style; the same number gives the same speaker.

    A number of style or voice is drawn from the range of the first six, made a fifth wider; those who are only tested
    have no part in it. Half of the numbers of the face are 0, as theirs are.
    """
    random = np.random.default_rng([number, len(SPEAKERS)])
    trained = [speaker for name, speaker in SPEAKERS.items() if name not in ("F4", "M4")]

    def between(values: list[float]) -> float:
        wider = 0.1 * (max(values) - min(values))
        drawn = float(random.uniform(min(values) - wider, max(values) + wider))
        return drawn if min(values) < 0 else max(0.0, drawn)

    style = {f.name: between([getattr(speaker.style, f.name) for speaker in trained]) for f in fields(SpeakingStyle)}
    shape = {f.name: float(random.uniform(-1.0, 1.0)) * int(random.integers(2)) for f in fields(Shape)}
    numbers = {key: round(between([getattr(speaker.voice, key) for speaker in trained])) for key in ("rate", "pitch")}
    voice = EspeakVoice(
        f"{random.choice(_VOICES)}+{random.choice(_VARIANTS)}",
        **numbers,
        pitch_range=round(between([speaker.voice.pitch_range for speaker in trained])),
    )
    return Speaker(f"{DRAWN}{number:02d}", voice, Shape(**shape), SpeakingStyle(**style))
