"""Acting: brows, head and lids that move with the speech by rules, in addition to the model's motion.

From top to bottom: the base class, registered under the kind ``acting``; and ``prosody``, which acts on accents,
stressed syllables and the ends of phrases. Frames come out while speech arrives, the same for a recording and a stream.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Annotated, Any, cast

import numpy as np

from facediff.errors import OptionError
from facediff.registry import UnknownComponentError, acting
from facediff.speech.prosody import ProsodicEvent, ProsodyTracker
from facediff.speech.voice_activity import HOP, Wave
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import checks_arguments
from facediff.utils.numerics import Array
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.animation import Animation

Acted = Array
"""Values of the channels :data:`facediff.editing.controls.controlled_face.ACTED` in each frame, (T, 5)."""

Strength = Annotated[float, Range(0, 2)]
Degrees = Annotated[float, Range(0, 10)]


class Acting(ABC):
    """Moves brows, head and lids with the speech."""

    look_ahead: float = 0.0  # Largest delay of a frame, in seconds of speech after it

    def __init_subclass__(cls, **options: Any) -> None:  # noqa: ANN401
        """Let every constructor refuse options that are out of range."""
        super().__init_subclass__(**options)
        if "__init__" in vars(cls):
            cls.__init__ = checks_arguments(cls.__init__, "acting")  # type: ignore[method-assign]

    @abstractmethod
    def performer(self, frame_rate: float, seed: int) -> Performer:
        """An actor at the beginning of a recording."""


class Performer(ABC):
    """Acts to one recording, frame by frame; a frame depends on speech up to a short time after it."""

    @abstractmethod
    def feed(self, samples: Wave) -> Acted:
        """The values (m, 5) of the frames that are certain with more speech (n,) at 16 kHz."""

    @abstractmethod
    def finish(self, frames: int) -> Acted:
        """The values (m, 5) of the frames that are left."""


def read_acting(text: str) -> Acting:
    """A kind of acting from ``NAME:option=value,option=value``.

    Example:
        >>> read_acting("prosody:brows=2").brows
        2.0
    """
    try:
        name, options = acting.read(text)
        return cast(Acting, acting.get(name)(**options))
    except UnknownComponentError as error:
        raise OptionError.naming(f"{{acting}} {text}: {error}") from error


def acted(kind: Acting, speech: Wave, frames: int, frame_rate: float, seed: int) -> Acted:
    """The values (frames, 5) for a whole recording (S,) at 16 kHz."""
    performer = kind.performer(frame_rate, seed)
    return np.concatenate([performer.feed(speech), performer.finish(frames)])[:frames]


def speech_16k(animation: Animation) -> Wave | None:
    """An animation's speech (S,) at 16 kHz, as models take it; None for a silent animation."""
    if animation.speech is None or animation.sample_rate == SAMPLE_RATE:
        return animation.speech
    from facediff.speech.audio import to_speech

    return to_speech(animation.speech, animation.sample_rate, animation.name)


def act(kind: Acting, animation: Animation, seed: int) -> Acted:
    """The values (T, 5) for an animation with its speech."""
    speech = speech_16k(animation)
    if speech is None:
        raise OptionError.naming(f"{animation.name}: {{acting}}: has no speech to act on; give it with {{speech}}")
    return acted(kind, speech, len(animation.vertices), animation.frame_rate, seed)


@acting.register("prosody")
class ProsodyActing(Acting):
    """Brows rise at accents, the head nods at stressed syllables and drifts, lids shut at the ends of phrases.

    That is what people do: brows rise with pitch accents (Cavé et al., "About the relationship between eyebrow
    movements and F0 variations", ICSLP 1996), and begin a little before them (Flecha-García, "Eyebrow raises in
    dialogue and their relation to discourse structure, utterance function and pitch accents in English", Speech
    Communication 52(6), 2010); heads move with stress and melody (Hadar et al., "Head movement correlates of juncture
    and stress at sentence level", Language and Speech 26(2), 1983; Graf et al., "Visual prosody: facial movements
    accompanying speech", Face and Gesture 2002; Munhall et al., "Visual prosody and speech intelligibility",
    Psychological Science 15(2), 2004; Busso et al., "Rigid head motion in expressive speech animation", IEEE
    Transactions on Audio, Speech, and Language Processing 15(3), 2007); and speakers blink where speech breaks off
    (Nakano and Kitazawa, "Eyeblink entrainment at breakpoints of speech", Experimental Brain Research 205(4), 2010).
    Which accents and syllables are acted, and which way, is random, by the seed.

    Args:
        strength: multiplies brows, nods and drift.
        brows: millimetres that brows rise at the strongest accents.
        nods: degrees of the largest nod.
        drift: largest angle in degrees of the head's slow turns and tilts during speech.
        blinks: share of phrase ends with a blink.
    """

    look_ahead = 1.5

    def __init__(
        self,
        *,
        strength: Strength = 1.0,
        brows: Annotated[float, Range(0, 8)] = 4.0,
        nods: Degrees = 3.0,
        drift: Degrees = 1.5,
        blinks: Annotated[float, Range(0, 1)] = 0.6,
    ) -> None:
        self.strength, self.brows, self.nods, self.drift, self.blinks = strength, brows, nods, drift, blinks

    def performer(self, frame_rate: float, seed: int) -> Performer:
        """An actor at the beginning of a recording."""
        return _ProsodyPerformer(self, frame_rate, seed)


# Seconds of the gestures: from rest to the peak, at the peak, and back; the peak begins so long before the event.
RAISE = (0.22, 0.06, 0.45)
BEFORE_ACCENT = 0.06  # Flecha-García 2010
NOD = (0.16, 0.0, 0.34)
TURN = (0.35, 0.15, 0.8)
BLINK = (0.10, 0.04, 0.20)
AHEAD = 0.45
"""Seconds of speech after a frame that must be decided on: gestures begin before their events, and drift sets in."""
LONGEST = 1.5
"""Seconds after its event in which every gesture is over."""
RAISES = 0.75  # Share of accents with raised brows
NODS, NODS_APART = 0.7, 0.45  # Share of stressed syllables with a nod, and seconds between nods at least
TURN_SHARE = 0.5  # How far an accent turns the head, as a share of the largest nod
BLINKS_APART = 1.0
SET_IN = 0.4  # Seconds before and after speech in which the drift sets in and dies down
WAVES = (0.13, 0.21, 0.34)  # Hertz of the drift, far below the rhythm of syllables
DRIFTS = (0.4, 1.0, 0.6)  # How much of it is nodding, turning and tilting
STREAM = 4  # of random numbers, next to those of facediff.editing.controls.procedural


def smoother_step(t: float) -> float:
    """6t⁵ − 15t⁴ + 10t³ of a number limited to 0 … 1: neither speed nor acceleration jumps at the ends."""
    t = min(max(t, 0.0), 1.0)
    return t * t * t * (t * (6 * t - 15) + 10)


def gesture(after: float, shape: tuple[float, float, float]) -> float:
    """How far a gesture has come, 0 to 1, so many seconds after its peak began (before it, if negative)."""
    attack, hold, decay = shape
    return smoother_step(after / attack + 1) * smoother_step(1 - (after - hold) / decay)


class _ProsodyPerformer(Performer):
    """Numbers are computed frame by frame in plain Python, so that they do not depend on how many are made together."""

    def __init__(self, options: ProsodyActing, frame_rate: float, seed: int) -> None:
        self.options, self.frame_rate, self.seed = options, frame_rate, seed
        self._prosody = ProsodyTracker()
        self._frames = 0  # given out
        self._seen = 0  # events that have been turned into gestures
        # Gestures by channel: seconds of the peak's beginning, and sizes.
        self._planned: tuple[list[Any], ...] = ([], [], [], [])
        self._raises, self._nods, self._turns, self._blinks = self._planned
        random = np.random.default_rng([seed, STREAM])
        self._phases = random.uniform(0, 2 * math.pi, (3, len(WAVES))).tolist()

    def feed(self, samples: Wave) -> Acted:
        """The frames that are certain with more speech."""
        # By the second: the tracker forgets where there was speech, which the frames of a long piece still ask for.
        acted = [self._feed(samples[first : first + SAMPLE_RATE]) for first in range(0, len(samples), SAMPLE_RATE)]
        return np.concatenate([np.zeros((0, 5)), *acted])

    def _feed(self, samples: Wave) -> Acted:
        self._prosody.feed(samples)
        self._plan()
        return self._up_to(math.floor((self._prosody.certain - AHEAD) * self.frame_rate))

    def finish(self, frames: int) -> Acted:
        """Silence follows the speech."""
        self._prosody.finish()
        self._plan()
        return self._up_to(frames)

    def _plan(self) -> None:
        """Make gestures of the events that are new."""
        for number, event in enumerate(self._prosody.events, self._seen):
            # Every event has random numbers of its own, which do not depend on earlier events.
            chance, size, turn, tilt = np.random.default_rng([self.seed, STREAM, number]).random(4).tolist()
            size = (0.6 + 0.4 * size) * event.strength
            self._act(event, chance, size, (2 * turn - 1, 2 * tilt - 1))
        self._seen += len(self._prosody.events)
        self._prosody.events.clear()

    def _act(self, event: ProsodicEvent, chance: float, size: float, way: tuple[float, float]) -> None:
        time = event.time
        if event.kind == "accent":
            if chance < RAISES:
                self._raises.append((time - BEFORE_ACCENT, size))
            self._turns.append((time, size * way[0], size * way[1]))
        elif event.kind == "stress":
            if chance < NODS and (not self._nods or time - self._nods[-1][0] >= NODS_APART):
                self._nods.append((time, size))
        elif chance < self.options.blinks and (not self._blinks or time - self._blinks[-1][0] >= BLINKS_APART):
            self._blinks.append((time + BLINK[0], 1.0))

    def _up_to(self, frames: int) -> Acted:
        """The values of frames up to a number, and forget what no later frame depends on."""
        values = [self._values(frame / self.frame_rate) for frame in range(self._frames, frames)]
        self._frames = max(frames, self._frames)
        over = self._frames / self.frame_rate - LONGEST
        for gestures in self._planned:
            # The latest one stays: the next one keeps a distance from it.
            while len(gestures) > 1 and gestures[0][0] < over:
                gestures.pop(0)
        return np.array(values, np.float64).reshape(-1, 5)

    def _values(self, seconds: float) -> list[float]:
        """The values at a time."""
        options = self.options
        drift = options.drift * self._liveliness(seconds)

        def wander(phases: list[float]) -> float:
            return sum(
                math.sin(2 * math.pi * rate * seconds + phase) for rate, phase in zip(WAVES, phases, strict=True)
            )

        pitch, yaw, roll = (
            drift * (share * wander(phases)) / len(WAVES) for share, phases in zip(DRIFTS, self._phases, strict=True)
        )
        pitch += options.nods * self._together(self._nods, NOD, seconds)
        for time, turn, tilt in self._turns:
            angle = TURN_SHARE * options.nods * gesture(seconds - time, TURN)
            yaw, roll = yaw + angle * turn, roll + angle * tilt
        raised = self._together(self._raises, RAISE, seconds)
        shut = max((gesture(seconds - time, BLINK) for time, _ in self._blinks), default=0.0)
        return [options.strength * options.brows * raised, shut, *(options.strength * a for a in (pitch, yaw, roll))]

    def _together(self, gestures: list[Any], shape: tuple[float, float, float], seconds: float) -> float:
        """Gestures that overlap, limited to 1."""
        # As probabilities combine: two overlapping rises go further than one, and no number of them beyond the end.
        return 1 - math.prod(1 - size * gesture(seconds - time, shape) for time, size in gestures)

    def _liveliness(self, seconds: float) -> float:
        """How lively the head is, 0 to 1: a weighted share of speech around a time."""
        first, last = (math.floor((seconds + way * SET_IN) * SAMPLE_RATE / HOP) for way in (-1, 1))
        weights = total = 0.0
        for step in range(first, last + 1):
            away = abs((step + 0.5) * HOP / SAMPLE_RATE - seconds) / SET_IN
            weight = 1 - smoother_step(away)
            total += weight
            weights += weight if step >= 0 and self._prosody.speaks(step) else 0.0
        # People pause between phrases: speech for half of the time gives the full liveliness.
        return smoother_step(2 * weights / total)
