"""From phonemes to mouth shapes: what the rig aims at while each sound of English is spoken."""

from __future__ import annotations

from dataclasses import dataclass

#: Rig controls that speech drives, in the order used by `facediff.puppet.coarticulation`.
SPEECH_CONTROLS = (
    "jaw_open",
    "lip_press",
    "pucker",
    "funnel",
    "stretch",
    "upper_lip_raise",
    "lower_lip_drop",
    "lower_lip_tuck",
    "corner_up",
    "cheek_puff",
    "chin_raise",
    "nose_wrinkle",
)


@dataclass(frozen=True)
class Viseme:
    """A mouth shape.

    Attributes:
        name: Short upper-case name.
        targets: Rig weights aimed at; controls not named aim at 0.
        strength: How firmly the sound insists on its shape against its neighbours (Cohen and Massaro's
            magnitude of dominance); weak sounds take the shape of the sounds beside them.
        reach: How far its influence spreads in time, as a factor.
        closes: Whether the lips meet.
        firm: Controls on which it insists with full strength whatever ``strength`` says.
    """

    name: str
    targets: dict[str, float]
    strength: float = 1.0
    reach: float = 1.0
    closes: bool = False
    firm: tuple[str, ...] = ()


_ALL = (
    Viseme("SIL", {}, strength=1.1, reach=0.9),
    Viseme(
        "PP",
        {"jaw_open": 0.16, "lip_press": 0.55, "cheek_puff": 0.25, "chin_raise": 0.1},
        0.6,
        0.8,
        True,
        ("lip_press",),
    ),
    Viseme("MM", {"jaw_open": 0.16, "lip_press": 0.4, "chin_raise": 0.1}, 0.6, 0.8, True, ("lip_press",)),
    Viseme(
        "FF",
        {"jaw_open": 0.14, "lower_lip_tuck": 1.0, "upper_lip_raise": 0.42, "nose_wrinkle": 0.1},
        1.2,
        0.7,
        firm=("lower_lip_tuck", "upper_lip_raise", "jaw_open"),
    ),
    Viseme("TH", {"jaw_open": 0.28, "lower_lip_drop": 0.25, "upper_lip_raise": 0.15}, 0.7, 0.8),
    Viseme("DD", {"jaw_open": 0.22, "stretch": 0.12, "lower_lip_drop": 0.2}, 0.55, 0.7),
    Viseme("SS", {"jaw_open": 0.12, "stretch": 0.3, "lower_lip_drop": 0.45, "upper_lip_raise": 0.25}, 0.9, 0.8),
    Viseme("CH", {"jaw_open": 0.14, "funnel": 0.8, "pucker": 0.2, "lower_lip_drop": 0.2}, 1.0, 1.0),
    Viseme("KK", {"jaw_open": 0.32}, 0.35, 0.8),
    Viseme("RR", {"jaw_open": 0.22, "funnel": 0.35, "pucker": 0.3}, 0.6, 1.1),
    Viseme("LL", {"jaw_open": 0.34, "upper_lip_raise": 0.1}, 0.6, 0.8),
    Viseme("WW", {"jaw_open": 0.14, "pucker": 1.0, "funnel": 0.15}, 1.2, 1.1),
    Viseme("YY", {"jaw_open": 0.16, "stretch": 0.45}, 0.7, 0.9),
    Viseme("HH", {"jaw_open": 0.35}, 0.2, 0.7),
    Viseme("AA", {"jaw_open": 1.0, "lower_lip_drop": 0.3, "upper_lip_raise": 0.15}, 1.2, 1.0),
    Viseme("AE", {"jaw_open": 0.85, "stretch": 0.4, "upper_lip_raise": 0.25, "lower_lip_drop": 0.35}, 1.1, 1.0),
    Viseme("AH", {"jaw_open": 0.58, "lower_lip_drop": 0.2, "upper_lip_raise": 0.1}, 0.9, 1.0),
    Viseme("UX", {"jaw_open": 0.36, "lower_lip_drop": 0.1}, 0.4, 0.9),
    Viseme("EH", {"jaw_open": 0.62, "stretch": 0.42, "upper_lip_raise": 0.15, "lower_lip_drop": 0.3}, 1.0, 1.0),
    Viseme("ER", {"jaw_open": 0.32, "funnel": 0.45, "pucker": 0.15, "lower_lip_drop": 0.15}, 0.9, 1.0),
    Viseme("IH", {"jaw_open": 0.36, "stretch": 0.42, "lower_lip_drop": 0.2}, 0.75, 0.9),
    Viseme(
        "IY",
        {"jaw_open": 0.24, "stretch": 0.95, "corner_up": 0.2, "lower_lip_drop": 0.3, "upper_lip_raise": 0.1},
        1.0,
        1.0,
    ),
    Viseme("OH", {"jaw_open": 0.68, "funnel": 0.6, "pucker": 0.4}, 1.1, 1.1),
    Viseme("UH", {"jaw_open": 0.34, "pucker": 0.65, "funnel": 0.2}, 0.9, 1.1),
    Viseme("UW", {"jaw_open": 0.14, "pucker": 1.1, "funnel": 0.12}, 1.1, 1.2),
)
VISEMES = {viseme.name: viseme for viseme in _ALL}

_SOUNDS = {
    "PP": "pb", "MM": "m", "FF": "fv", "TH": "θð", "DD": "tdnɾ", "SS": "sz", "CH": "ʃʒ", "KK": "kɡgŋxʔ",
    "RR": "ɹr", "LL": "lɫ", "WW": "wʍ", "YY": "j", "HH": "h", "AA": "ɑa", "AE": "æ", "AH": "ʌ", "UX": "ɐə",
    "ER": "ɚɜɝ", "EH": "ɛe", "IH": "ɪᵻ", "IY": "i", "OH": "ɔoɒø", "UH": "ʊɵ", "UW": "uy",
}  # fmt: skip
_VISEME_OF = {sound: name for name, sounds in _SOUNDS.items() for sound in sounds}
_MARKS = "ˈˌːˑ̩̃ʲ̯̆ "


def visemes_of(ipa: str) -> tuple[str, ...]:
    """Name the mouth shapes of a phoneme in order: a diphthong or an affricate has several.

    Args:
        ipa: Phoneme as espeak-ng names it, with stress and length marks; empty for a pause.

    Returns:
        Names found in `VISEMES`; ``("SIL",)`` for a pause, ``("UX",)`` for a sound that is not known.
    """
    sounds = [letter for letter in ipa if letter not in _MARKS]
    if not sounds:
        return ("SIL",)
    if "".join(sounds) in ("tʃ", "dʒ"):
        return ("CH",)
    names: list[str] = []
    for sound in sounds:
        name = _VISEME_OF.get(sound)
        if name and (not names or names[-1] != name):
            names.append(name)
    return tuple(names) or ("UX",)


def is_stressed(ipa: str) -> bool:
    """Say whether the phoneme carries primary stress."""
    return "ˈ" in ipa
