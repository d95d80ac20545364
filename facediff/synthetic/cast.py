"""The speakers of the built-in corpus: a face, a complexion, a voice and habits each.

The ten of :data:`CAST` are written down; further ones are drawn from the space of people that the seen ones span.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import lru_cache

import numpy as np

from facediff.synthetic.head.people import EYE_COLOURS, HAIR_COLOURS, SHIRTS, SKIN_TONES, Complexion, Face
from facediff.synthetic.performance import SpeakingHabits


@dataclass(frozen=True)
class CastMember:
    """One of the speakers: a voice (:mod:`facediff.synthetic.voices`), its delivery, a face and its habits.

    Rate and range of the pitch are factors of the voice's own; the pitch is semitones above it.
    """

    name: str
    voice: str
    rate: float
    pitch: float
    pitch_range: float
    face: Face
    complexion: Complexion
    habits: SpeakingHabits


SEEN = ("F1", "F2", "F3", "M1", "M2", "M3")
UNSEEN = ("F4", "F5", "M4", "M5")

_CAST = (
    CastMember(
        *("F1", "espeak:en-us+f2", 1.02, 1.2, 1.1),
        Face(sex=-0.9, age=-0.3, lips=0.4, eye_size=0.4, cheekbones=0.4, nose_up=0.4),
        Complexion("fair", "auburn", "green", "bob", "teal"),
        SpeakingHabits(rounding=1.05, smile=0.06, outer_brow=0.5, blinks=26, nods=3.0),
    ),
    CastMember(
        *("F2", "espeak:en-gb-x-rp+f3", 0.97, 1.8, 1.35),
        Face(sex=-0.8, weight=0.6, width=0.4, length=-0.5, lips=0.6, cheeks=0.5, nose_length=-0.4),
        Complexion("brown", "black", "brown", "bun", "rust"),
        SpeakingHabits(jaw=1.2, lips=1.25, inner_brow=0.75, outer_brow=0.6, blinks=18, sway=2.2, asymmetry=0.08),
    ),
    CastMember(
        *("F3", "espeak:en+f4", 1.1, 0.4, 0.8),
        Face(sex=-0.6, age=0.9, length=0.3, nose_length=0.4, cheekbones=0.3),
        Complexion("pale", "grey", "blue", "short", "wine"),
        SpeakingHabits(jaw=0.8, rounding=0.85, slack=1.25, lead=-0.02, frown=0.08, blinks=34, nods=1.5, gaze_away=0.5),
    ),
    CastMember(
        *("M1", "espeak:en-us+m3", 1.0, -1.5, 0.9),
        Face(sex=0.9, jaw=0.3, brow_ridge=0.3, nose_bridge=0.3),
        Complexion("tan", "brown", "brown", "short", "sand", stubble=0.35),
        SpeakingHabits(jaw=1.05, spreading=0.85, lead=0.01, inner_brow=0.35, squint=0.08, blinks=20, tilt=1.5),
    ),
    CastMember(
        *("M2", "espeak:en-gb-scotland+m2", 1.08, -0.6, 1.2),
        Face(sex=0.7, age=-0.5, width=-0.4, length=0.5, nose_tip=0.4, eye_gap=-0.3),
        Complexion("pale", "blond", "blue", "cropped", "navy"),
        SpeakingHabits(spreading=1.25, slack=0.8, smoothness=0.011, smile=0.1, outer_brow=0.65, blinks=30, nods=4.0),
    ),
    CastMember(
        *("M3", "espeak:en+m7", 0.93, -2.2, 0.7),
        Face(sex=0.8, age=0.7, weight=0.7, nose_width=0.6, lips=0.5, width=0.3),
        Complexion("dark", "black", "brown", "bald", "moss", stubble=0.25),
        SpeakingHabits(jaw=0.9, rounding=1.2, lips=0.85, asymmetry=-0.1, frown=0.05, blinks=14, gaze_away=0.25),
    ),
    CastMember(
        *("F4", "espeak:en-us+f5", 1.05, 0.8, 1.0),
        Face(sex=-0.7, eye_gap=0.4, nose_bridge=-0.6, cheekbones=0.6, eye_tilt=0.5),
        Complexion("olive", "black", "brown", "long", "slate"),
        SpeakingHabits(jaw=1.1, spreading=1.1, smile=0.04, inner_brow=0.6, blinks=22),
    ),
    CastMember(
        *("F5", "espeak:en-gb-x-rp+f1", 0.95, 2.2, 1.15),
        Face(sex=-1.0, age=-0.7, weight=-0.4, jaw=-0.4, lips=0.2, forehead=0.4),
        Complexion("fair", "blond", "grey", "long", "wine"),
        SpeakingHabits(rounding=1.15, lips=1.1, slack=1.1, asymmetry=0.1, blinks=28, nods=2.0, sway=1.0),
    ),
    CastMember(
        *("M4", "espeak:en-us+m1", 1.04, -1.0, 1.1),
        Face(sex=1.0, weight=-0.4, length=0.3, chin=0.4, nose_length=0.4),
        Complexion("fair", "brown", "green", "short", "moss", stubble=0.3),
        SpeakingHabits(jaw=1.0, spreading=1.05, lead=-0.01, outer_brow=0.5, squint=0.05, blinks=24, tilt=-1.0),
    ),
    CastMember(
        *("M5", "espeak:en-gb-scotland+m6", 0.98, -1.8, 0.85),
        Face(sex=0.6, age=0.4, width=0.4, cheeks=0.4, nose_width=0.3, ears=0.5),
        Complexion("olive", "grey", "brown", "cropped", "navy", stubble=0.2),
        SpeakingHabits(jaw=0.85, lips=1.15, slack=0.9, inner_brow=0.55, smile=0.08, blinks=18, gaze_away=0.45),
    ),
)
CAST = {member.name: member for member in _CAST}

DRAWN, RECORDED = "X", "P"
"""How names of drawn speakers start, ``X01``, ``X02`` …, and of those who speak with recordings, ``P001`` …"""
ALIGNED = "aligned"
"""Program of the voices that are a person's recordings."""
MOST_DRAWN = 9999
RECORDED_FROM = 10_000
"""Added to the number of a speaker who speaks with recordings, so that nobody else has the same face."""
KEPT_OUT = ("espeak:en-us+f5", "espeak:en-gb-x-rp+f1", "espeak:en-us+m1", "espeak:en-gb-scotland+m6", "espeak:en+m8")
"""espeak-ng's voices outside the training data: of the unseen speakers and one of test C."""
KEPT_OUT_PEOPLE = ("flite:slt",)
"""Voices of people that no speaker is trained with; they speak in test C."""
_LANGUAGES = ("en-us", "en-gb-x-rp", "en-gb-scotland", "en")
_VARIANTS = ("f1", "f2", "f3", "f4", "f5", "m1", "m2", "m3", "m4", "m6", "m7")


def drawn_names(count: int) -> tuple[str, ...]:
    """Names of the first ``count`` drawn speakers."""
    return tuple(f"{DRAWN}{number:02d}" for number in range(1, count + 1))


def recorded_names(people: Sequence[str]) -> tuple[str, ...]:
    """Names of the speakers who speak with recordings, one for each of those among the voices of people."""
    return tuple(f"{RECORDED}{number:03d}" for number, _ in enumerate(_voices(people, recorded=True), 1))


def _voices(people: Sequence[str], *, recorded: bool) -> tuple[str, ...]:
    return tuple(voice for voice in people if voice.startswith(f"{ALIGNED}:") == recorded)


def member_of(name: str, people: Sequence[str] = ()) -> CastMember:
    """One of the cast, or a drawn speaker, by name; ``people`` are the voices of people that drawn ones speak with."""
    if name in CAST:
        return CAST[name]
    number = int(name[1:])
    if name.startswith(DRAWN):
        return _drawn(number, _voices(people, recorded=False))
    voices = _voices(people, recorded=True)
    return replace(_drawn(RECORDED_FROM + number, ()), name=name, voice=voices[number - 1] if voices else "")


@lru_cache(maxsize=128)
def _drawn(number: int, people: tuple[str, ...]) -> CastMember:
    """A speaker with random face, complexion, voice and habits; the same number gives the same speaker.

    Habits lie in the range of the seen six, a fifth wider; those who are only tested have no part in it.
    """
    random = np.random.default_rng([number, 2])
    members = [CAST[name] for name in SEEN]
    sex = float(random.choice([-1.0, 1.0]) * random.uniform(0.4, 1.0))
    details = {item.name: float(np.clip(random.normal(0.0, 0.45), -1.0, 1.0)) for item in fields(Face)}
    face = Face(**{**details, "sex": sex})
    complexion = Complexion(
        str(random.choice([*SKIN_TONES])),
        str(random.choice([*HAIR_COLOURS])),
        str(random.choice([*EYE_COLOURS])),
        random.choice(["short", "bob", "long", "bun"] if sex < 0 else ["short", "cropped", "bald"]),
        shirt=[*SHIRTS][number % len(SHIRTS)],
        stubble=0.1 * (number % 5) if sex > 0 else 0.0,
    )
    habits = {}
    for item in fields(SpeakingHabits):
        values = [getattr(member.habits, item.name) for member in members]
        wider = 0.1 * (max(values) - min(values))
        value = float(random.uniform(min(values) - wider, max(values) + wider))
        habits[item.name] = value if min(values) < 0 else max(0.0, value)
    letter = "f" if sex < 0 else "m"
    voices = [f"espeak:{language}+{kind}" for language in _LANGUAGES for kind in _VARIANTS if kind.startswith(letter)]
    espeak = str(random.choice([voice for voice in voices if voice not in KEPT_OUT]))
    voice = people[(number // 2) % len(people)] if people and number % 2 else espeak
    rate, pitch, spread = random.uniform(0.92, 1.12), random.uniform(-1.5, 1.5), random.uniform(0.7, 1.35)
    return CastMember(f"{DRAWN}{number:02d}", voice, rate, pitch, spread, face, complexion, SpeakingHabits(**habits))
