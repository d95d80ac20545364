"""Mouth shapes that flow into one another: overlapping dominance functions.

After Cohen and Massaro, "Modeling coarticulation in synthetic visual speech" (1993): each segment has, for
each control, a target and a dominance that falls off on both sides of it, and the control at a time is the
mean of the targets weighted by their dominance then. Two things differ: the fall-off has a rounded top
(their |t| becomes sqrt(t^2 + e^2)), so that trajectories have no corners, and the meeting of the lips has a
channel of its own that a neighbouring vowel cannot hold open, because a b with open lips is no b.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from facediff.puppet.curves import Array, rise
from facediff.puppet.speech import Phoneme
from facediff.puppet.visemes import SPEECH_CONTROLS, VISEMES, Viseme, is_stressed, visemes_of

_ROUND_TOP = 0.018
# Seconds in which dominance falls to 1/e, before and after a segment. Rounding is prepared early.
_FALL_BEFORE = {
    "pucker": 0.085,
    "funnel": 0.080,
    "stretch": 0.070,
    "lower_lip_tuck": 0.035,
    "lip_press": 0.035,
}
_FALL_AFTER = {
    "pucker": 0.070,
    "funnel": 0.065,
    "stretch": 0.060,
    "lower_lip_tuck": 0.035,
    "lip_press": 0.035,
}
_DEFAULT_FALL = 0.052
_FIRM_STRENGTH = 3.0
_SURELY_SHUT = 0.028
_UNHURRIED = 0.11
# Shortest and longest time in seconds that the lips take to meet and to part.
_CLOSING, _OPENING = (0.050, 0.070), (0.060, 0.085)


@dataclass(frozen=True)
class Segment:
    """A stretch of speech with one mouth shape.

    Attributes:
        start: Where it starts, in seconds.
        end: Where it ends, in seconds.
        viseme: Its mouth shape.
        stress: How fully its target is meant to be reached, about 1.
    """

    start: float
    end: float
    viseme: Viseme
    stress: float


def segments_of(phonemes: tuple[Phoneme, ...]) -> list[Segment]:
    """Split phonemes into segments of one mouth shape each; a diphthong spends more time on its first."""
    segments: list[Segment] = []
    for phoneme in phonemes:
        names = visemes_of(phoneme.ipa)
        stress = 1.08 if is_stressed(phoneme.ipa) else 0.95
        shares = np.cumsum([0.0, *([0.6] + [0.4 / (len(names) - 1)] * (len(names) - 1) if len(names) > 1 else [1.0])])
        length = phoneme.end - phoneme.start
        # A short sound does not reach its target (Lindblom's undershoot, 1963): jaws have no time for it.
        stress *= float(np.clip(0.5 + 0.5 * length / _UNHURRIED, 0.5, 1.0))
        segments += [
            Segment(phoneme.start + float(a) * length, phoneme.start + float(b) * length, VISEMES[name], stress)
            for name, a, b in zip(names, shares[:-1], shares[1:], strict=True)
        ]
    return segments


def articulate(segments: list[Segment], times: Array, *, spread: float = 1.0) -> Array:
    """Blend the segments' targets.

    Args:
        segments: Segments in order, covering the clip.
        times: Times to look at, in seconds, shape (n,).
        spread: How widely sounds influence each other; below 1 is crisp, above 1 is slack.

    Returns:
        Weights of `SPEECH_CONTROLS`, shape (n, controls).
    """
    start = np.array([s.start for s in segments])
    end = np.array([s.end for s in segments])
    # The target belongs to the segment's middle part; towards its borders it is already leaving.
    core = 0.25 * (end - start)
    before = np.maximum(start + core - times[:, None], 0.0)
    after = np.maximum(times[:, None] - end + core, 0.0)
    result = np.zeros((len(times), len(SPEECH_CONTROLS)))
    reach = spread * np.array([s.viseme.reach for s in segments])
    for column, control in enumerate(SPEECH_CONTROLS):
        fall_before = reach * _FALL_BEFORE.get(control, _DEFAULT_FALL)
        fall_after = reach * _FALL_AFTER.get(control, _DEFAULT_FALL)
        strength = np.array([_FIRM_STRENGTH if control in s.viseme.firm else s.viseme.strength for s in segments])
        distance = _rounded(before) / fall_before + _rounded(after) / fall_after
        dominance = strength * np.exp(-distance)
        target = np.array([s.stress * s.viseme.targets.get(control, 0.0) for s in segments])
        result[:, column] = (dominance * target).sum(axis=1) / (dominance.sum(axis=1) + 1e-9)
    return result


def close_lips(segments: list[Segment], times: Array) -> Array:
    """How firmly the lips are shut, 0 to 1: 1 from before the start to past the middle of every p, b and m.

    Args:
        segments: Segments in order.
        times: Times to look at, in seconds, shape (n,).

    Returns:
        Closure, shape (n,).
    """
    apart = np.ones_like(times)
    lengths = [segment.end - segment.start for segment in segments]
    for index, (segment, length) in enumerate(zip(segments, lengths, strict=True)):
        if segment.viseme.closes:
            # The frame nearest to the middle, up to half a frame away, shall find the lips shut.
            middle = segment.start + 0.5 * length
            first = min(segment.start + min(0.15 * length, 0.012), middle - _SURELY_SHUT)
            last = max(segment.start + 0.72 * length, middle + _SURELY_SHUT)
            # A short vowel between two closures is left time to open.
            closing = np.clip(0.55 * lengths[index - 1], *_CLOSING) if index > 0 else _CLOSING[1]
            opening = np.clip(0.55 * lengths[index + 1], *_OPENING) if index + 1 < len(lengths) else _OPENING[1]
            shut = rise(times, first - float(closing), first) * rise(times, last + float(opening), last)
            apart *= 1.0 - shut
    return np.asarray(1.0 - apart)


def _rounded(distance: Array) -> Array:
    """Distance with a rounded start, so that its slope is continuous where a segment's core begins."""
    return np.asarray(np.sqrt(distance**2 + _ROUND_TOP**2) - _ROUND_TOP)
