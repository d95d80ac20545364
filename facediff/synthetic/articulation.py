"""From phonemes of any language to the mouth: the targets of each sound, and the blending of neighbours.

Sounds are described by features of the International Phonetic Alphabet (place and manner of consonants; height,
backness and rounding of vowels), and the targets of the rig follow from the features, so that a language needs no table
of its own. Neighbouring sounds blend by overlapping dominance functions (Cohen and Massaro, "Modeling coarticulation in
synthetic visual speech", 1993). Next to any neighbour, lips meet for p, b and m, and the lower lip touches the upper
teeth for f and v.
"""

from __future__ import annotations

import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import numpy as np

from facediff.spaces.arkit import LEFT_AND_RIGHT
from facediff.speech.espeak import SpokenPhoneme
from facediff.synthetic.geometry import Array, rise

_ROUND_TOP = 0.018
_SURELY_SHUT = 0.028
UNHURRIED = 0.11
_CLOSING, _OPENING = (0.050, 0.070), (0.060, 0.085)
"""Shortest and longest time in seconds that the lower lip takes to a contact, and away from it."""

# Vowels: how open (0 close to 1 open), how far back (0 front to 1 back) and how rounded they are. IPA chart of 2020.
VOWELS: dict[str, tuple[float, float, float]] = {
    **{"i": (0.0, 0.0, 0.0), "y": (0.0, 0.0, 1.0), "ɨ": (0.0, 0.5, 0.0), "ʉ": (0.0, 0.5, 1.0), "ɯ": (0.0, 1.0, 0.0)},
    **{"u": (0.0, 1.0, 1.0), "ɪ": (0.17, 0.15, 0.0), "ʏ": (0.17, 0.15, 1.0), "ʊ": (0.17, 0.85, 1.0)},
    **{"e": (0.33, 0.0, 0.0), "ø": (0.33, 0.0, 1.0), "ɘ": (0.33, 0.5, 0.0), "ɵ": (0.33, 0.5, 1.0)},
    **{"ɤ": (0.33, 1.0, 0.0), "o": (0.33, 1.0, 1.0), "ə": (0.5, 0.5, 0.0), "ɛ": (0.67, 0.0, 0.0)},
    **{"œ": (0.67, 0.0, 1.0), "ɜ": (0.67, 0.5, 0.0), "ɞ": (0.67, 0.5, 1.0), "ʌ": (0.67, 1.0, 0.0)},
    **{"ɔ": (0.67, 1.0, 1.0), "æ": (0.83, 0.0, 0.0), "ɐ": (0.83, 0.5, 0.0), "a": (1.0, 0.2, 0.0)},
    **{"ɶ": (1.0, 0.0, 1.0), "ɑ": (1.0, 1.0, 0.0), "ɒ": (1.0, 1.0, 1.0)},
    **{"ɚ": (0.5, 0.5, 0.3), "ɝ": (0.6, 0.5, 0.3), "ᵻ": (0.1, 0.5, 0.0)},  # as espeak-ng writes them
}
_REDUCED = "əɐᵻɚ"
"""Vowels that take their shape from their neighbours."""

# Consonants by place and manner, as far as either can be seen.
_CONSONANTS: dict[str, str] = {
    **{"bilabial stop": "pb", "bilabial nasal": "m", "bilabial fricative": "ɸβ", "bilabial trill": "ʙ"},
    **{"labiodental nasal": "ɱ", "labiodental fricative": "fv", "labiodental approximant": "ʋⱱ"},
    **{"dental fricative": "θð", "alveolar stop": "td", "alveolar nasal": "n", "alveolar sibilant": "sz"},
    **{"alveolar trill": "r", "alveolar tap": "ɾ", "alveolar rhotic": "ɹɺ", "alveolar lateral": "lɫɬɮ"},
    **{"postalveolar sibilant": "ʃʒɕʑ", "retroflex stop": "ʈɖ", "retroflex nasal": "ɳ", "retroflex sibilant": "ʂʐ"},
    **{"retroflex rhotic": "ɻɽ", "retroflex lateral": "ɭ", "palatal stop": "cɟ", "palatal nasal": "ɲ"},
    **{"palatal fricative": "çʝ", "palatal approximant": "j", "palatal lateral": "ʎ", "velar stop": "kɡg"},
    **{"velar nasal": "ŋ", "velar fricative": "xɣɧ", "velar approximant": "ɰ", "velar lateral": "ʟ"},
    **{"uvular stop": "qɢ", "uvular nasal": "ɴ", "uvular fricative": "χʁ", "uvular trill": "ʀ"},
    **{"pharyngeal fricative": "ħʕ", "glottal stop": "ʔ", "glottal fricative": "hɦ"},
    **{"labial-velar approximant": "wʍ", "labial-palatal approximant": "ɥ"},
}
_CONSONANT_OF = {symbol: kind for kind, symbols in _CONSONANTS.items() for symbol in symbols}


@dataclass(frozen=True)
class Articulation:
    """The targets of a sound in the face.

    Attributes:
        targets: weights of the rig's shapes; those with two sides are named without one.
        strength: how much it dominates its neighbours (Cohen and Massaro's magnitude of dominance); weak sounds take
            the shape of the sounds next to them.
        reach: how far its influence spreads in time, as a factor.
        contact: the part that the lower lip touches, the upper ``lip`` or ``teeth``, or none.
    """

    targets: dict[str, float]
    strength: float = 1.0
    reach: float = 1.0
    contact: Literal["", "lip", "teeth"] = ""


PAUSE = Articulation({}, strength=1.1, reach=0.9)


def _vowel(symbol: str) -> Articulation:
    opened, back, rounded = VOWELS[symbol]
    spread = (1.0 - rounded) * (1.0 - back)
    targets = {
        # The jaw turns by about 9 degrees for an open vowel (Vatikiotis-Bateson and Ostry, 1995).
        "jawOpen": 0.07 + 0.37 * opened,
        "mouthPucker": rounded * (0.95 - 0.75 * opened),
        "mouthFunnel": rounded * (0.15 + 0.5 * min(1.0, 1.6 * opened)),
        "mouthStretch": spread * (0.5 - 0.3 * opened),
        "mouthSmile": spread * (0.20 - 0.12 * opened),
        "mouthLowerDown": (1.0 - 0.7 * rounded) * (0.14 + 0.14 * opened),
        "mouthUpperUp": (1.0 - rounded) * (0.06 + 0.10 * (1.0 - back) * opened),
    }
    reduced = symbol in _REDUCED
    return Articulation(targets, strength=0.45 if reduced else 0.85 + 0.35 * max(opened, rounded))


LIP_AT_TEETH = {
    **{"jawOpen": 0.07, "mouthRollLower": 0.72, "mouthUpperUp": 0.4},
    **dict.fromkeys(("mouthLowerDown", "mouthFunnel", "mouthPucker", "mouthStretch", "mouthShrugLower"), 0.0),
}
"""Weights at which the lower lip lies at the edge of the upper incisors, which are seen."""
_PLACES: dict[str, Articulation] = {
    "bilabial": Articulation({"jawOpen": 0.06, "mouthPress": 0.45, "mouthShrugLower": 0.1}, 0.6, 0.8, "lip"),
    "labiodental": Articulation({name: LIP_AT_TEETH[name] for name in ("jawOpen", "mouthUpperUp")}, 0.8, 0.7, "teeth"),
    "dental": Articulation(
        {"jawOpen": 0.11, "mouthLowerDown": 0.25, "mouthUpperUp": 0.12, "tongueForward": 0.9}, 0.7, 0.8
    ),
    "alveolar": Articulation(
        {"jawOpen": 0.08, "mouthLowerDown": 0.22, "mouthStretch": 0.1, "tongueUp": 0.9}, 0.55, 0.7
    ),
    "postalveolar": Articulation(
        {"jawOpen": 0.05, "mouthFunnel": 0.65, "mouthPucker": 0.2, "mouthLowerDown": 0.2}, 1.0
    ),
    "retroflex": Articulation({"jawOpen": 0.09, "mouthLowerDown": 0.2, "tongueUp": 0.6}, 0.55, 0.8),
    "palatal": Articulation({"jawOpen": 0.07, "mouthStretch": 0.35, "tongueUp": 0.5}, 0.7, 0.9),
    "velar": Articulation({"jawOpen": 0.13}, 0.35, 0.8),
    "uvular": Articulation({"jawOpen": 0.16}, 0.35, 0.8),
    "pharyngeal": Articulation({"jawOpen": 0.22}, 0.35, 0.8),
    "glottal": Articulation({"jawOpen": 0.14}, 0.2, 0.7),
    "labial-velar": Articulation({"jawOpen": 0.05, "mouthPucker": 0.95, "mouthFunnel": 0.12}, 1.2, 1.1),
    "labial-palatal": Articulation({"jawOpen": 0.05, "mouthPucker": 0.85, "mouthFunnel": 0.12}, 1.2, 1.1),
}
# Changes of a place by a manner.
_SIBILANT = {"jawOpen": 0.035, "mouthLowerDown": 0.4, "mouthUpperUp": 0.2}
_RHOTIC = {"mouthFunnel": 0.3, "mouthPucker": 0.28}


@lru_cache(maxsize=512)
def articulations(ipa: str) -> tuple[Articulation, ...]:
    """The targets of a phoneme, in order: a diphthong or an affricate has several parts, a pause is :data:`PAUSE`.

    Length and stress marks are left out, labialisation (ʷ) rounds and palatalisation (ʲ) spreads; a symbol that is
    not in the chart stands for a sound that is not seen.
    """
    parts: list[Articulation] = []
    for symbol in unicodedata.normalize("NFD", ipa):
        if symbol in VOWELS:
            parts.append(_vowel(symbol))
        elif symbol in _CONSONANT_OF:
            parts.append(_consonant(*_CONSONANT_OF[symbol].split()))
        elif symbol in "ʷʲ":
            if not parts:  # espeak-ng gives a glide that follows its consonant a phoneme of its own
                parts.append(_consonant(*("palatal approximant" if symbol == "ʲ" else _CONSONANT_OF["w"]).split()))
            more = {"mouthPucker": 0.7} if symbol == "ʷ" else {"mouthStretch": 0.3}
            parts[-1] = replace(parts[-1], targets={**parts[-1].targets, **more})
    if not parts:
        return (PAUSE,) if not any(letter.isalpha() for letter in ipa) else (Articulation({"jawOpen": 0.1}, 0.3),)
    # A plosive and the sibilant of its place are one gesture: t and ʃ share the lips of the latter.
    if len(parts) == 2 and ipa[0] in "tdʈɖ" and _CONSONANT_OF.get(ipa[-1], "").endswith("sibilant"):
        return (replace(parts[1], targets={**parts[1].targets, "tongueUp": 0.8}),)
    return tuple(parts)


def _consonant(location: str, manner: str) -> Articulation:
    sound = _PLACES[location]
    if manner == "sibilant":
        sound = replace(
            sound, targets={**sound.targets, **_SIBILANT, "tongueUp": 0.3}, strength=max(0.9, sound.strength)
        )
    elif manner == "rhotic":
        sound = replace(sound, targets={**sound.targets, **_RHOTIC}, reach=1.1)
    elif location == "bilabial" and manner == "stop":  # air builds up behind the lips
        sound = replace(sound, targets={**sound.targets, "mouthPress": 0.55, "cheekPuff": 0.12})
    elif location == "bilabial" and manner == "fricative":
        sound = replace(sound, contact="")
    elif manner == "lateral":
        sound = replace(sound, targets={**sound.targets, "jawOpen": 0.13})
    return sound


SPEECH_SHAPES = (
    *("jawOpen", "mouthFunnel", "mouthPucker", "mouthStretch", "mouthSmile", "mouthLowerDown", "mouthUpperUp"),
    *("mouthRollLower", "mouthPress", "mouthShrugLower", "cheekPuff", "tongueUp", "tongueForward"),
)
"""Shapes that speech drives; those with two sides are named without one."""
SIDED = frozenset(LEFT_AND_RIGHT)

_BLOCK, _OUT_OF_REACH = 1024, 1.5
"""Times that are blended together, and seconds beyond which a sound's dominance is nothing (e^-15 and less)."""
# Seconds in which dominance falls to 1/e, before and after a sound. Rounding is prepared early.
_FALL_BEFORE = {"mouthPucker": 0.085, "mouthFunnel": 0.080, "mouthStretch": 0.070}
_FALL_AFTER = {"mouthPucker": 0.070, "mouthFunnel": 0.065, "mouthStretch": 0.060}
_QUICK = {"mouthPress": 0.035, "tongueUp": 0.032, "tongueForward": 0.035}
_USUAL_FALL = 0.052
_FIRM = 3.0
"""Strength with which lips that meet press, and with which rounded sounds narrow the mouth, next to any neighbour."""


@dataclass(frozen=True)
class SpeechSound:
    """A stretch of speech with one articulation."""

    start: float  # In seconds
    end: float
    articulation: Articulation
    stress: float  # How much of its target is reached, about 1


def speech_sounds(phonemes: Sequence[SpokenPhoneme]) -> list[SpeechSound]:
    """Split phonemes into stretches of one articulation each; a diphthong spends more time on its first."""
    sounds: list[SpeechSound] = []
    for phoneme in phonemes:
        parts = articulations(phoneme.ipa)
        length = phoneme.end - phoneme.start
        stress = 1.08 if "ˈ" in phoneme.ipa else 0.95
        # A short sound does not reach its target (Lindblom's undershoot, 1963): jaws have no time for it.
        stress *= float(np.clip(0.5 + 0.5 * length / UNHURRIED, 0.5, 1.0))
        later = [0.4 / (len(parts) - 1)] * (len(parts) - 1) if len(parts) > 1 else []
        shares = np.cumsum([0.0, 0.6 if later else 1.0, *later])
        sounds += [
            SpeechSound(phoneme.start + float(first) * length, phoneme.start + float(last) * length, part, stress)
            for part, first, last in zip(parts, shares[:-1], shares[1:], strict=True)
        ]
    return sounds


def blend(sounds: Sequence[SpeechSound], times: Array, *, spread: float = 1.0) -> Array:
    """Weights (n, shapes) of :data:`SPEECH_SHAPES` at times (n,) in seconds: the blended targets of the sounds.

    ``spread`` is how widely sounds influence one another; below 1 is crisp, above 1 is slack.
    """
    weights = np.zeros((len(times), len(SPEECH_SHAPES)))
    for first in range(0, len(times), _BLOCK):
        block = times[first : first + _BLOCK]
        near = [s for s in sounds if s.start < block[-1] + _OUT_OF_REACH and s.end > block[0] - _OUT_OF_REACH]
        if near:
            weights[first : first + _BLOCK] = _blend_block(near, block, spread)
    return weights


def _blend_block(sounds: Sequence[SpeechSound], times: Array, spread: float) -> Array:
    """What :func:`blend` gives for times that all of the sounds may reach."""
    start, end = (np.array([getattr(sound, name) for sound in sounds]) for name in ("start", "end"))
    # A target holds in the sound's middle part and fades from there towards both borders.
    core = 0.25 * (end - start)
    before = _rounded(np.maximum(start + core - times[:, None], 0.0))
    after = _rounded(np.maximum(times[:, None] - end + core, 0.0))
    reach = spread * np.array([sound.articulation.reach for sound in sounds])
    weights = np.zeros((len(times), len(SPEECH_SHAPES)))
    for column, shape in enumerate(SPEECH_SHAPES):
        quick = _QUICK.get(shape, _USUAL_FALL)
        fall_before, fall_after = reach * _FALL_BEFORE.get(shape, quick), reach * _FALL_AFTER.get(shape, quick)
        strength = np.array([_strength(sound.articulation, shape) for sound in sounds])
        dominance = strength * np.exp(-before / fall_before - after / fall_after)
        target = np.array([sound.stress * sound.articulation.targets.get(shape, 0.0) for sound in sounds])
        weights[:, column] = (dominance * target).sum(axis=1) / (dominance.sum(axis=1) + 1e-9)
    return weights


def _strength(sound: Articulation, shape: str) -> float:
    pressed = shape == "mouthPress" and sound.contact == "lip"
    rounded = shape in ("mouthPucker", "mouthStretch") and sound.targets.get("mouthPucker", 0.0) > 0.6
    return _FIRM if pressed or rounded else sound.strength


def lip_contact(sounds: Sequence[SpeechSound], times: Array, contact: Literal["lip", "teeth"]) -> Array:
    """How near the lower lip is to the upper lip or teeth (n,), 0 to 1: 1 from the start to past the middle of sounds.

    The sounds are p, b and m, or f and v.
    """
    apart = np.ones_like(times)
    lengths = [sound.end - sound.start for sound in sounds]
    for index, (sound, length) in enumerate(zip(sounds, lengths, strict=True)):
        if sound.articulation.contact == contact:
            start = sound.start
            # They must touch in the frame nearest to the middle, which is up to half a frame away.
            middle = start + 0.5 * length
            first = min(start + min(0.15 * length, 0.012), middle - _SURELY_SHUT)
            last = max(start + 0.72 * length, middle + _SURELY_SHUT)
            # A short vowel between two contacts needs time to open.
            closing = np.clip(0.55 * lengths[index - 1], *_CLOSING) if index > 0 else _CLOSING[1]
            opening = np.clip(0.55 * lengths[index + 1], *_OPENING) if index + 1 < len(lengths) else _OPENING[1]
            shut = rise(times, first - float(closing), first) * rise(times, last + float(opening), last)
            apart *= 1.0 - shut
    return np.asarray(1.0 - apart)


def _rounded(distance: Array) -> Array:
    """Distance with a rounded start, so that its slope is continuous where a segment's core begins."""
    return np.asarray(np.sqrt(distance**2 + _ROUND_TOP**2) - _ROUND_TOP)
