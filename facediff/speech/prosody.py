"""The melody of speech: its pitch, and where it has accents, stressed syllables and the ends of phrases.

Every decision waits for the same short time, so that recordings and streams give the same events.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from facediff.speech.voice_activity import HOP, EnergyGate, VoiceGate, Wave
from facediff.utils import SAMPLE_RATE

LOWEST, HIGHEST = 65.0, 500.0
"""Hertz between which voices are looked for."""
LONGEST_LAG, SHORTEST_LAG = math.ceil(SAMPLE_RATE / LOWEST), math.floor(SAMPLE_RATE / HIGHEST)
SUMMED = 400
"""Samples over which a lag is compared: 25 ms."""
SPAN = SUMMED + LONGEST_LAG + 2
"""Samples that the pitch of a step is found from, around its middle."""
DIP = 0.15
"""Difference, as a share of the mean of all shorter lags, below which a lag is a period."""
AT_MOST = 0.35
"""Difference of the best lag above which a step has no pitch."""

SLOW = 300
"""Steps over which the usual pitch and loudness of a speaker are averaged: 3 s of voice."""
SETTLED = 15
"""Steps of voice before anything counts as above the usual."""
SEMITONES, DECIBELS = 4.0, 8.0
"""The height of a whole accent above the usual value."""
PITCH_SHARE = 0.7
"""How much of an accent is pitch; the rest is loudness."""
ACCENT, RISE = 0.3, 0.2
"""The least prominence of an accent, and how much of that is new within 0.2 s."""
ACCENT_APART, BEAT_APART = 40, 22
"""Steps from an accent, and from a stressed syllable, to the next one at least."""
SYLLABLE_DIP = 3.0
"""Decibels by which a stressed syllable is louder than the sound within 0.2 s before or after it."""
NEAR = 20
"""Steps on both sides among which an accent is the most prominent: 0.2 s."""
PHRASE, PAUSE = 50, 25
"""Steps of speech that make a phrase, and of silence that end it."""
KEPT = 400
"""Steps before the latest decision that are remembered."""


def pitch_of(piece: Wave) -> float | None:
    """Fundamental frequency in Hertz in the middle of a piece (SPAN,) of speech; None where there is no voice.

    The method is YIN (de Cheveigné and Kawahara, "YIN, a fundamental frequency estimator for speech and music", Journal
    of the Acoustical Society of America 111(4), 2002), with its steps 2 to 5: difference, its normalisation by the mean
    of shorter lags, an absolute threshold and a parabola.
    """
    wave = np.asarray(piece[:SPAN], np.float64)
    wave = wave - wave.mean()
    lags = LONGEST_LAG + 2
    size = 1 << (SPAN + SUMMED - 1).bit_length()
    head = np.fft.rfft(wave[:SUMMED][::-1], size)
    products = np.fft.irfft(np.fft.rfft(wave, size) * head, size)[SUMMED - 1 : SUMMED - 1 + lags]
    squares = np.concatenate([[0.0], np.cumsum(wave**2)])
    powers = squares[SUMMED : SUMMED + lags] - squares[:lags]
    if SUMMED * wave[:SUMMED].var() < 1e-7:  # silence, also where an onset after it moves the mean of the piece
        return None
    difference = np.maximum(powers[0] + powers - 2 * products, 0.0)
    sums = np.cumsum(difference[1:])
    normal = np.ones(lags)
    normal[1:] = difference[1:] * np.arange(1, lags) / np.maximum(sums, 1e-12)
    inside = normal[SHORTEST_LAG : LONGEST_LAG + 1]
    below = np.flatnonzero(inside < DIP)
    best = int(below[0]) if len(below) else int(np.argmin(inside))
    while best + 1 < len(inside) and inside[best + 1] < inside[best]:  # the first dip, down to its bottom
        best += 1
    if inside[best] > AT_MOST:
        return None
    lag = best + SHORTEST_LAG
    left, middle, right = difference[lag - 1 : lag + 2]
    bend = left - 2 * middle + right
    # The dip is one of the normalised difference: the bottom of the plain one may lie elsewhere.
    shift = 0.5 * (left - right) / bend if bend > 0 else 0.0
    return float(SAMPLE_RATE / (lag + min(max(shift, -1.0), 1.0)))


@dataclass(frozen=True)
class ProsodicEvent:
    """An accent of the pitch, a stressed syllable or the end of a phrase; time in seconds, strength from 0 to 1."""

    kind: Literal["accent", "stress", "phrase_end"]
    time: float
    strength: float


class ProsodyTracker:
    """Follows the prosody of one recording, in pieces; a gate says when there is speech.

    An accent is where pitch, and to a lesser part loudness, rises above the speaker's usual value so far; a
    stressed syllable is a peak of loudness; a phrase ends where half a second of speech or more is followed by a pause.
    """

    look_ahead = PAUSE + 2
    """Steps after one that are heard before it is decided on, in addition to the gate's."""

    def __init__(self, gate: VoiceGate | None = None) -> None:
        self.gate = EnergyGate() if gate is None else gate
        self.events: list[ProsodicEvent] = []
        self._listener = self.gate.listener()
        self._speech = np.zeros(SPAN // 2)  # silence before the recording, so that its first step has a middle
        self._to_hear = np.zeros(0)
        # One value for every step, from the first that is still remembered.
        self._first = 0
        self._active: list[bool] = []
        self._pitch: list[float | None] = []  # semitones
        self._level: list[float] = []  # decibels
        self._prominence: list[float] = []
        self._above: list[float] = []  # decibels above the usual ones
        self._usual = [0.0, 0.0]  # semitones and decibels of the voice so far
        self._voiced = 0
        self._decided = 0
        self._last = {"accent": -1000, "stress": -1000, "phrase_end": -1000}
        self._phrase = 0  # steps of speech in the present phrase

    @property
    def certain(self) -> float:
        """Seconds up to which everything is known."""
        return self._decided * HOP / SAMPLE_RATE

    def speaks(self, step: int) -> bool:
        """Whether there is speech in a step of 10 ms; the latest :data:`KEPT` of those that are certain are known."""
        at = step - self._first
        return 0 <= at < len(self._active) and self._active[at]

    def feed(self, samples: Wave) -> None:
        """Take more samples (n,) at 16 kHz."""
        new = np.asarray(samples, np.float64)
        self._to_hear = np.concatenate([self._to_hear, new])
        complete = len(self._to_hear) // HOP
        if complete:
            self._active += self._listener.hear(self._to_hear[: complete * HOP].reshape(-1, HOP))
            self._to_hear = self._to_hear[complete * HOP :]
        self._speech = np.concatenate([self._speech, new])
        start = 0
        while len(self._speech) - start >= SPAN + HOP:
            self._measure(self._speech[start : start + SPAN + HOP])
            start += HOP
        self._speech = self._speech[start:]
        while self._decided + self.look_ahead < self._first + min(len(self._active), len(self._prominence)):
            self._decide(self._decided - self._first)
            self._decided += 1
        drop = max(0, self._decided - KEPT - self._first)
        for values in (self._active, self._pitch, self._level, self._prominence, self._above):
            del values[:drop]
        self._first += drop

    def finish(self) -> None:
        """Decide on all that is left; silence follows the recording."""
        self.feed(np.zeros((self.look_ahead + self.gate.look_ahead + 10) * HOP + SPAN))

    def _measure(self, piece: Wave) -> None:
        """Pitch, level and prominence of one more step."""
        pitch = pitch_of(piece[HOP // 2 : HOP // 2 + SPAN])
        middle = piece[SPAN // 2 - HOP : SPAN // 2 + 2 * HOP]
        level = 10 * math.log10(float(np.square(middle).mean()) + 1e-12)
        self._pitch.append(None if pitch is None else 12 * math.log2(pitch / LOWEST))
        self._level.append(level)
        # A median takes out single steps an octave away; it needs two more steps.
        voiced = [semitone for semitone in self._pitch[-5:] if semitone is not None]
        at = len(self._pitch) - 3
        prominence = 0.0
        if at >= 0 and len(voiced) >= 3 and self._pitch[at] is not None and self._level[at] > -60:
            semitones, level = sorted(voiced)[len(voiced) // 2], self._level[at]
            self._voiced += 1
            share = 1 / min(self._voiced, SLOW)
            above = (semitones - self._usual[0], level - self._usual[1]) if self._voiced > SETTLED else (0.0, 0.0)
            self._usual[0] += share * (semitones - self._usual[0])
            self._usual[1] += share * (level - self._usual[1])
            # Loudness alone makes no accent: every phrase begins with a rise of it.
            high, loud = max(above[0] / SEMITONES, 0.0), min(max(above[1] / DECIBELS, 0.0), 1.0)
            prominence = PITCH_SHARE * min(high, 1.5) + (1 - PITCH_SHARE) * loud
        if at >= 0:
            self._prominence.append(prominence)
            self._above.append(self._level[at] - self._usual[1])

    def _decide(self, at: int) -> None:
        """Whether something happens in a step, which is remembered at this place."""
        active = self._active[at]
        if active:
            self._phrase += 1
        elif self._phrase and not any(self._active[at : at + PAUSE]):
            if self._phrase >= PHRASE:
                self._add("phrase_end", at, 1.0)
            self._phrase = 0
        if not active:
            return
        low, high = max(0, at - NEAR), at + NEAR + 1
        around = [_mean(self._prominence, step) for step in range(low, high)]
        centre, before = around[at - low], around[: at - low]
        if centre > max(ACCENT, min(before, default=0.0) + RISE, max(before, default=0.0)) and centre >= max(around):
            self._add("accent", at, min(1.0, centre), apart=ACCENT_APART)
        levels = [_mean(self._level, step) for step in range(low, high)]
        level, close = levels[at - low], levels[max(0, at - low - 8) : at - low + 9]
        dips = level - max(min(levels[: at - low + 1]), min(levels[at - low :])) > SYLLABLE_DIP
        if level >= max(close) and dips and self._pitch[at] is not None and self._above[at] > -SYLLABLE_DIP:
            strength = min(1.0, max(0.0, 0.5 + self._above[at] / (2 * DECIBELS) + centre / 2))
            self._add("stress", at, strength, apart=BEAT_APART)

    def _add(self, kind: Literal["accent", "stress", "phrase_end"], at: int, strength: float, apart: int = 0) -> None:
        """An event in a step, unless it follows another one of its kind too soon."""
        step = self._first + at
        if apart and step - self._last[kind] < apart:
            return
        self._last[kind] = step
        self.events.append(ProsodicEvent(kind, (step + 0.5) * HOP / SAMPLE_RATE, strength))


def _mean(values: list[float], at: int) -> float:
    """Mean of the five values around a place."""
    some = values[max(0, at - 2) : at + 3]
    return sum(some) / max(len(some), 1)
