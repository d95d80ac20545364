"""How a mouth articulates: whether it closes for p, b and m and for nothing else, opens for vowels and rounds.

A mouth that hardly opens is closed in time as well: the share of closures within a millimetre says nothing without the
share at any other moment. So every closure is ranked against the other sounds (AUC), and openings and widths are taken
at the sounds that ask for them. Motion and truth of the same recordings give shares of the truth's.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import astuple, dataclass, fields

import numpy as np
import numpy.typing as npt

from facediff.data.track.face import pair_distances
from facediff.speech.phonemes import TimedPhoneme, closing
from facediff.synthetic.articulation import VOWELS

Array = npt.NDArray[np.float64]

CLOSED = 1.0  # millimetres between the lips
NEAR = 0.04  # seconds around the middle of a sound in which the lips may meet
LENGTH = "ː"
OPEN_VOWELS = ("a", "ɑ", "æ", "ɐ", "ɒ")
ROUNDED = ("u", "ʊ", "w", "o", "ɔʊ", "əʊ", "oʊ")
LABIODENTALS = ("f", "v")


@dataclass(frozen=True, eq=False)
class MouthMotion:
    """The mouth of a recording, and its words."""

    gap: Array  # (T,) between the inner lips, in millimetres beyond that of the face at rest
    width: Array  # (T,) from corner to corner, the same
    frame_rate: float  # frames a second; frame t shows the face at (t + 0.5) / frame_rate
    phonemes: Sequence[TimedPhoneme]  # with times in seconds
    contact: Array | None = None  # (T,) from the lower lip to the upper teeth in millimetres, of faces that have teeth

    def around(self, series: Array, phoneme: TimedPhoneme, pick: Callable[[Array], float]) -> float:
        """The smallest, largest … value within :data:`NEAR` of a phoneme's middle."""
        first = math.floor((phoneme.middle - NEAR) * self.frame_rate)
        frames = series[max(first, 0) : math.ceil((phoneme.middle + NEAR) * self.frame_rate)]
        return float(pick(frames)) if len(frames) else math.nan


def mouth_motion(
    vertices: npt.NDArray[np.floating],
    template: npt.NDArray[np.floating],
    lip_pairs: npt.NDArray[np.integer],
    *,
    millimetres: float,
    frame_rate: float,
    phonemes: Sequence[TimedPhoneme],
    lip_teeth_pairs: npt.NDArray[np.integer] | None = None,
) -> MouthMotion:
    """The mouth of vertices (T, V, 3) of an upright face that looks along z, of (V, 3) at rest.

    Args:
        vertices: the motion.
        template: the face at rest.
        lip_pairs: (P, 2) of the inner lips, upper and lower; the outermost are the corners.
        millimetres: that a unit of length has.
        frame_rate: frames a second.
        phonemes: of the speech.
        lip_teeth_pairs: (P, 2) of the lower lip and the upper teeth's edge, of faces that have teeth.
    """
    upper = np.asarray(lip_pairs)[:, 0]
    sideways = template[upper, 0]
    corners = [(upper[sideways.argmin()], upper[sideways.argmax()])]

    def beyond_rest(pairs: npt.ArrayLike) -> Array:
        moving, resting = (np.asarray(pair_distances(faces, pairs), np.float64) for faces in (vertices, template[None]))
        return millimetres * (moving - resting)

    contact = None
    if lip_teeth_pairs is not None:
        contact = millimetres * np.asarray(pair_distances(vertices, lip_teeth_pairs), np.float64)
    return MouthMotion(beyond_rest(lip_pairs), beyond_rest(corners), frame_rate, phonemes, contact)


@dataclass(frozen=True)
class ArticulationScores:
    """Scores of one or several recordings; NaN where their speech does not have the sounds."""

    closure_auc: float  # how well gaps tell p, b and m from all other sounds: 0.5 by chance, 1 at best
    closed: float  # share of p, b and m at which the lips come within 1 mm
    chance: float  # the same share of all other sounds
    open_vowels: float  # mean opening of a, ɑ, æ … in millimetres
    rounding: float  # width of the mouth at u, o and w less that at other vowels, in millimetres; negative if it rounds
    rounding_auc: float  # how well widths tell these sounds apart
    contact: float = math.nan  # share of f and v at which the lower lip comes within 1 mm of the upper teeth

    def shares_of(self, truth: ArticulationScores) -> dict[str, float]:
        """Every score as a share of the truth's; NaN where that is 0."""
        pairs = zip(fields(self), astuple(self), astuple(truth), strict=True)
        return {each.name: value / true if true else math.nan for each, value, true in pairs}


def articulation(recordings: Sequence[MouthMotion]) -> ArticulationScores:
    """The scores over all sounds of recordings."""
    sounds: list[tuple[MouthMotion, TimedPhoneme, str]] = []
    for each in recordings:
        bilabials = closing([phoneme.ipa for phoneme in each.phonemes])
        names = [b or phoneme.plain.rstrip(LENGTH) for phoneme, b in zip(each.phonemes, bilabials, strict=True)]
        sounds += [(each, phoneme, ipa) for phoneme, ipa in zip(each.phonemes, names, strict=True) if ipa]

    def values(series: str, pick: Callable[[Array], float], fits: Callable[[str], bool]) -> Array:
        found = [each.around(getattr(each, series), phoneme, pick) for each, phoneme, ipa in sounds if fits(ipa)]
        return np.array([value for value in found if not math.isnan(value)])

    shut = values("gap", np.min, lambda ipa: ipa in ("p", "b", "m"))
    others = values("gap", np.min, lambda ipa: ipa not in ("p", "b", "m"))
    opened = values("gap", np.max, lambda ipa: ipa.startswith(OPEN_VOWELS))
    rounded = values("width", np.mean, lambda ipa: ipa.startswith(ROUNDED))
    spread = values("width", np.mean, lambda ipa: ipa[0] in VOWELS and not ipa.startswith(ROUNDED))
    touching = np.array([])
    if all(each.contact is not None for each in recordings):
        touching = values("contact", np.min, lambda ipa: ipa in LABIODENTALS)
    return ArticulationScores(
        closure_auc=area_under_curve(-shut, -others),
        closed=_mean(shut < CLOSED),
        chance=_mean(others < CLOSED),
        open_vowels=_mean(opened),
        rounding=_mean(rounded) - _mean(spread),
        rounding_auc=area_under_curve(-rounded, -spread),
        contact=_mean(touching < CLOSED),
    )


def area_under_curve(higher: Array, lower: Array) -> float:
    """The share of pairs in which a value of the first kind exceeds one of the second; ties count half.

    Example:
        >>> area_under_curve(np.array([3.0, 2.0]), np.array([1.0, 2.0]))
        0.875
    """
    if not len(higher) or not len(lower):
        return math.nan
    ordered = np.sort(lower)
    below = np.searchsorted(ordered, higher, "left") + np.searchsorted(ordered, higher, "right")
    return float(below.mean() / (2 * len(lower)))


def _mean(values: Array | npt.NDArray[np.bool_]) -> float:
    return float(np.mean(values)) if len(values) else math.nan
