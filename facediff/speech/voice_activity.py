"""When a recording has speech, and how far a mouth may therefore be open in each frame.

Detectors, registered as ``voice_gate``, say for every 10 ms whether there is speech; :class:`Openness` makes of that a
smooth number for every motion frame, in recordings and in streams alike.
"""

from __future__ import annotations

import importlib.util
import itertools
import math
from abc import ABC, abstractmethod
from collections import deque
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, cast

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, OptionError
from facediff.registry import UnknownComponentError, voice_gate
from facediff.utils import SAMPLE_RATE
from facediff.utils.hints import checks_arguments
from facediff.utils.numerics import RecursiveFilter
from facediff.utils.ranges import Range

Wave = npt.NDArray[np.floating]
"""Speech (S,) at 16 kHz."""

HOP = SAMPLE_RATE // 100
"""Samples of a step of 10 ms."""

USUAL_GATE: Final = "energy"
"""The default detector of pauses."""

QUICK_GATE = "energy:attack=0.04,lead=0.02,ahead=0"
"""The same where frames must be certain at once: it looks 0.08 s ahead."""

OFF: Final = "off"
"""In place of a detector's name: the mouth follows the model in pauses too."""

QUIETEST = -65.0
"""Decibels of full scale below which nothing is speech."""

SILENT = -120.0
"""Decibels of a step without any sound."""

LOUDEST_ABOVE = 40.0
"""Decibels below the loudest speech so far at which nothing is speech any more."""

FADING = 3.0
"""Decibels by which the loudest speech is forgotten in a second."""

SMOOTH = 5
"""Steps over which levels are averaged."""

FLAT = 7.0
"""Decibels within which the level of steady noise stays for :data:`SHORT` steps if it is far below the speech."""

SHORT = 25
"""Steps of 10 ms for which it does."""

AS_LOUD = ((60, 3.0), (100, 5.0))
"""Steps, and decibels within which noise stays for so long that is as loud as the speech.

Words in one breath stay within 7 dB for 60 steps in one clip of fifty, and so in one of four hundred (built-in corpus,
four synthesisers). White and pink noise stay within 3 dB, noise with a spectrum of 1/f² within 5.
"""

LONG = AS_LOUD[-1][0]
"""Steps that are remembered for it."""

CLEARLY = 10.0
"""Decibels that make noise clearly softer than speech."""

MEMORY = 500
"""Steps for which the level of noise is remembered."""

NEAR = 14
"""Steps on either side of one, within which something must be nearly as loud as the loudest for it to be speech."""

NEARLY = 9.0
"""Decibels below the loudest that are nearly as loud."""

BACKGROUND = 34.0
"""Decibels below the loudest: a recording never softer for :data:`MEMORY` steps has something besides speech in it."""

HYSTERESIS = 3.0
"""Decibels by which speech must fall below the limit that it has risen above."""

Seconds = Annotated[float, Range(0, 2)]


class VoiceGate(ABC):
    """Tells when there is speech, and how quickly a mouth comes to rest and leaves it.

    Args:
        attack: seconds in which the gate opens.
        lead: seconds before speech at which it is open, since a mouth moves before it is heard.
        hold: seconds after speech for which it stays open.
        release: seconds in which it closes.
    """

    look_ahead: int = 0
    """Steps after one that the detector hears before it decides."""

    @partial(checks_arguments, path="voice gate")
    def __init__(
        self, *, attack: Seconds = 0.1, lead: Seconds = 0.12, hold: Seconds = 0.1, release: Seconds = 0.15
    ) -> None:
        self.attack, self.lead, self.hold, self.release = attack, lead, hold, release
        if attack + lead > 0.5:
            raise FaceDiffError(
                f"voice gate: attack and lead are {attack:g} and {lead:g} s; expected at most 0.5 s together"
            )

    def __init_subclass__(cls, **keywords: Any) -> None:  # noqa: ANN401
        """Let every constructor refuse options that are out of range."""
        super().__init_subclass__(**keywords)
        if "__init__" in vars(cls):
            cls.__init__ = checks_arguments(cls.__init__, "voice gate")  # type: ignore[method-assign]

    @abstractmethod
    def listener(self) -> Listener:
        """A detector at the beginning of a recording."""


class Listener(ABC):
    """A detector that hears one recording, step by step."""

    @abstractmethod
    def hear(self, steps: npt.NDArray[np.float64]) -> list[bool]:
        """Whether there is speech in the steps that are certain after hearing more, (n, HOP) samples."""

    @abstractmethod
    def finish(self) -> list[bool]:
        """The same for the steps that are left."""


def read_gate(text: str) -> VoiceGate | None:
    """A gate from ``NAME:option=value,option=value``; None for ``off``."""
    if text.strip() == OFF:
        return None
    try:
        name, options = voice_gate.read(text)
    except UnknownComponentError as error:
        raise OptionError.naming(f"{{voice_gate}} {text}: {error}; or {OFF}") from error
    return cast(VoiceGate, voice_gate.get(name)(**options))


@voice_gate.register("energy")
class EnergyGate(VoiceGate):
    """Speech rises above the noise; the noise's level is followed.

    The level between 150 Hz and 5 kHz is compared with the noise's: the softest stretch of the last 5 s, and of
    the speech ahead, in which it was steady. Where nothing was steady yet, only sound far below the loudest is a
    pause.

    Args:
        margin: decibels above the noise at which speech begins.
        ahead: seconds that are heard ahead; without them, the first sound after a start is taken for speech.
        timing: options of :class:`VoiceGate`.
    """

    def __init__(
        self,
        *,
        margin: Annotated[float, Range(1, 40)] = 8.0,
        ahead: Seconds = 0.7,
        **timing: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**timing)
        self.margin, self.ahead = margin, ahead
        self.look_ahead = round(ahead * 100)

    def listener(self) -> Listener:
        """A detector at the beginning of a recording."""
        return _EnergyListener(self)


SPEECH_BAND = (
    (0.3979518861810659, 0.7959037723621318, 0.3979518861810659, 1.0, 0.44530146335179394, 0.21624043303098522),
    (1.0, -2.0, 1.0, 1.0, -1.9167376370775666, 0.9201986372050089),
)
"""150 Hz to 5 kHz at 16 kHz: the sections of SciPy's ``butter(2, (150, 5000), "bandpass", fs=16000, output="sos")``."""


class _EnergyListener(Listener):
    """Follows level, noise and loudest speech; its decision for a step depends on steps up to look-ahead only."""

    def __init__(self, gate: EnergyGate) -> None:
        self.gate = gate
        self._band = RecursiveFilter(SPEECH_BAND)
        self._recent: deque[float] = deque(maxlen=SMOOTH)  # powers of the latest steps
        self._levels: deque[float] = deque(maxlen=LONG)  # smoothed levels of the latest steps
        self._waiting: deque[float] = deque()  # levels that are not decided yet
        self._short: deque[tuple[int, float]] = deque()  # steady stretches (last step, level), softer ones later
        self._long: deque[tuple[int, float]] = deque()
        self._softest: deque[tuple[int, float]] = deque()  # smoothed levels, steady or not; softer ones later
        self._past: deque[float] = deque(maxlen=NEAR + 1)  # levels of the latest steps that were decided on
        self._loudest = QUIETEST
        self._step = -1  # the latest one that was heard
        self._speaking = False

    def hear(self, steps: npt.NDArray[np.float64]) -> list[bool]:
        """Decide on steps that lie look-ahead before the latest."""
        if not len(steps):
            return []
        band = self._band.feed(steps.reshape(-1))
        decisions = []
        for power in np.square(band.reshape(steps.shape)).mean(axis=1).tolist():
            self._follow(power)
            if len(self._waiting) > self.gate.look_ahead:
                decisions.append(self._decide())
        return decisions

    def finish(self) -> list[bool]:
        """Decide on all that is left."""
        return [self._decide() for _ in range(len(self._waiting))]

    def _follow(self, power: float) -> None:
        """Take in the power of one more step."""
        self._step += 1
        self._recent.append(power)
        mean = sum(self._recent) / len(self._recent)
        level = 10 * math.log10(mean) if mean > 1e-12 else SILENT
        # A gate must not wait for an average: a step that is loud by itself is loud.
        self._waiting.append(max(level, 10 * math.log10(power) if power > 1e-12 else SILENT))
        self._levels.append(level)
        self._loudest = max(level, self._loudest - FADING / 100, QUIETEST)
        _add_softer(self._softest, self._step, level)
        _forget(self._softest, self._step)
        latest = list(self._levels)
        for length, flat, stretches in (
            (SHORT, FLAT, self._short),
            *((length, flat, self._long) for length, flat in AS_LOUD),
        ):
            some = [max(step_level, QUIETEST - 20) for step_level in latest[-length:]]
            if len(some) == length and max(some) - min(some) < flat:
                steady = sum(some) / length
                _add_softer(stretches, self._step, steady)
            _forget(stretches, self._step)

    def _decide(self) -> bool:
        """Whether the first step that waits is speech."""
        level = self._waiting.popleft()
        self._past.append(level)
        limit = max(QUIETEST, self._loudest - LOUDEST_ABOVE)
        noise = [self._long[0][1]] if self._long else []
        if self._short and self._short[0][1] < self._loudest - CLEARLY:
            noise.append(self._short[0][1])
        if noise:
            limit = max(limit, min(noise) + self.gate.margin)
        self._speaking = level > (limit - HYSTERESIS if self._speaking else limit)
        return self._speaking and not self._behind_speech()

    def _behind_speech(self) -> bool:
        """Whether something sounds all the time, and nothing around the step is nearly as loud as the speech was."""
        # Without these steps the first sounds of a word are as soft as music. Where nothing else sounds, speech
        # itself is silent for a moment at every p, t and k.
        if self.gate.look_ahead < NEAR or self._softest[0][1] < self._loudest - BACKGROUND:
            return False
        return max(*self._past, *itertools.islice(self._waiting, NEAR)) < self._loudest - NEARLY


def _add_softer(stretches: deque[tuple[int, float]], step: int, value: float) -> None:
    """Add the latest stretch to those that may become the softest one."""
    while stretches and stretches[-1][1] >= value:
        stretches.pop()
    stretches.append((step, value))


def _forget(stretches: deque[tuple[int, float]], step: int) -> None:
    """Drop the stretches that are too long ago."""
    while stretches and stretches[0][0] < step - MEMORY:
        stretches.popleft()


@voice_gate.register("silero")
class SileroGate(EnergyGate):
    """Speech rises above the noise, as for ``energy``, and Silero's network hears a voice: music is none.

    The network (Silero team, MIT, 2.3 MB) comes with ``pip install --no-deps silero-vad`` (5 or 6).

    Args:
        threshold: probability above which there is a voice.
        model: path of silero_vad.onnx; that of the installed package if empty.
        energy: options of :class:`EnergyGate`.
    """

    def __init__(
        self,
        *,
        threshold: Annotated[float, Range(0, 1)] = 0.5,
        model: str = "",
        **energy: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**energy)
        self.threshold = threshold
        self.look_ahead = max(self.look_ahead, math.ceil(SILERO_CHUNK / HOP))
        self.model = Path(model).expanduser() if model else installed_silero()
        if not self.model.is_file():
            raise FaceDiffError(
                f"voice gate silero: {self.model} is not there; `pip install --no-deps silero-vad`, or give "
                f"silero:model=FILE"
            )

    def listener(self) -> Listener:
        """A detector at the beginning of a recording."""
        return _SileroListener(self)


def installed_silero() -> Path:
    """Where the package silero-vad has its network; it is not imported, since that takes PyTorch and torchaudio."""
    spec = importlib.util.find_spec("silero_vad")
    folders = [] if spec is None else list(spec.submodule_search_locations or [])
    return Path(folders[0] if folders else ".") / "data" / "silero_vad.onnx"


SILERO_CHUNK, SILERO_CONTEXT = 512, 64
"""Samples that the network hears at a time, and those before them that it hears again."""


class _SileroListener(Listener):
    """A step is speech if it is for the level, and for the network in the chunk of the step's middle."""

    def __init__(self, gate: SileroGate) -> None:
        import onnxruntime  # type: ignore[import-untyped]

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.gate = gate
        self._level = _EnergyListener(gate)
        self._network = onnxruntime.InferenceSession(gate.model, options, providers=["CPUExecutionProvider"])
        self._state = np.zeros((2, 1, 128), np.float32)
        self._context = np.zeros(SILERO_CONTEXT, np.float32)
        self._unheard = np.zeros(0, np.float32)  # samples that fill no chunk yet
        self._loud: deque[bool] = deque()  # steps that the network has not decided on
        self._voiced: list[bool] = []  # chunks, the first of which is the one of the first step that waits
        self._steps = self._chunks = 0  # steps that were decided on, and chunks that were dropped

    def hear(self, steps: npt.NDArray[np.float64]) -> list[bool]:
        """Decide on the steps of which level and network are known."""
        self._loud += self._level.hear(steps)
        self._unheard = np.concatenate([self._unheard, steps.reshape(-1).astype(np.float32)])
        while len(self._unheard) >= SILERO_CHUNK:
            chunk, self._unheard = self._unheard[:SILERO_CHUNK], self._unheard[SILERO_CHUNK:]
            self._voiced.append(self._probability(chunk) >= self.gate.threshold)
        return self._decided()

    def finish(self) -> list[bool]:
        """Decide on all that is left, as if silence followed."""
        self._loud += self._level.finish()
        if len(self._unheard):
            rest = np.pad(self._unheard, (0, SILERO_CHUNK - len(self._unheard)))
            self._voiced.append(self._probability(rest) >= self.gate.threshold)
        return self._decided()

    def _probability(self, chunk: npt.NDArray[np.float32]) -> float:
        heard = np.concatenate([self._context, chunk])
        self._context = heard[-SILERO_CONTEXT:]
        feeds = {"input": heard[None], "state": self._state, "sr": np.array(SAMPLE_RATE, np.int64)}
        probability, self._state = self._network.run(None, feeds)
        return float(np.asarray(probability).item())

    def _decided(self) -> list[bool]:
        decisions = []
        while self._loud and (chunk := (self._steps * HOP + HOP // 2) // SILERO_CHUNK - self._chunks) < len(
            self._voiced
        ):
            decisions.append(self._loud.popleft() and self._voiced[chunk])
            self._steps += 1
        drop = min((self._steps * HOP + HOP // 2) // SILERO_CHUNK - self._chunks, len(self._voiced))
        self._voiced, self._chunks = self._voiced[drop:], self._chunks + drop
        return decisions


class Openness:
    """How far a mouth may be open in each frame, from 0 (at rest) to 1 (as the model moves it).

    It is 1 from ``lead`` before speech until ``hold`` after it, and rises and falls smoothly. A frame depends on speech
    up to :attr:`look_ahead` after it, and not on how the speech was cut into pieces.
    """

    def __init__(self, gate: VoiceGate, frame_rate: float) -> None:
        self.gate, self.frame_rate = gate, frame_rate
        self._listener = gate.listener()
        self._rest = np.zeros(0)  # samples that fill no step yet
        self._active: list[bool] = []
        self._first = 0  # the step of the first of these
        self._frames = 0  # frames that were given
        self._ahead = math.ceil((gate.attack + gate.lead) * 100)
        self._behind = math.ceil((gate.hold + gate.release) * 100)

    @property
    def look_ahead(self) -> float:
        """Seconds of speech after a frame that decide on it."""
        return (self.gate.look_ahead + self._ahead + 2) / 100

    def feed(self, samples: Wave) -> npt.NDArray[np.float32]:
        """Hear more (n,) at 16 kHz; the openness (m,) of the frames that are certain now."""
        speech = np.concatenate([self._rest, np.asarray(samples, np.float64)])
        complete = len(speech) // HOP
        self._rest = speech[complete * HOP :]
        self._active += self._listener.hear(speech[: complete * HOP].reshape(-1, HOP))
        last = self._first + len(self._active) - self._ahead - 1
        return self._up_to(max(self._frames, math.floor(last / 100 * self.frame_rate)))

    def finish(self, frames: int) -> npt.NDArray[np.float32]:
        """The openness (m,) of the frames that are left."""
        self._active += self._listener.finish()
        return self._up_to(max(frames, self._frames))

    def _up_to(self, frames: int) -> npt.NDArray[np.float32]:
        """The openness of frames up to a number, and forget what no later frame depends on."""
        values = np.array([self._of(frame) for frame in range(self._frames, frames)], np.float32)
        self._frames = frames
        needed = math.floor((frames + 0.5) / self.frame_rate * 100) - self._behind - 2
        drop = max(0, needed - self._first)
        self._active, self._first = self._active[drop:], self._first + min(drop, len(self._active))
        return values

    def _of(self, frame: int) -> float:
        """The openness of a frame, by the nearest speech before and after it."""
        middle = (frame + 0.5) / self.frame_rate * 100  # in steps
        low = max(0, math.floor(middle) - self._behind - 1 - self._first)
        high = max(0, math.ceil(middle) + self._ahead + 1 - self._first)
        openness = 0.0
        for step, active in enumerate(self._active[low:high], start=low + self._first):
            if active:
                away = (step + 0.5 - middle) / 100  # seconds until that step; negative after it
                margin, ramp = (self.gate.lead, self.gate.attack) if away > 0 else (self.gate.hold, self.gate.release)
                beyond = abs(away) - margin
                share = 0.0 if beyond <= 0 else min(1.0, beyond / ramp) if ramp > 0 else 1.0
                openness = max(openness, 1 - share * share * (3 - 2 * share))
        return openness


def openness(speech: Wave, frames: int, frame_rate: float, gate: VoiceGate) -> npt.NDArray[np.float32]:
    """How far a mouth may be open in each frame (frames,) of a whole recording (S,); see :class:`Openness`."""
    tracker = Openness(gate, frame_rate)
    # By the second, since what a gate computes is several times as large as the speech.
    parts = [tracker.feed(speech[start : start + SAMPLE_RATE]) for start in range(0, len(speech), SAMPLE_RATE)]
    return np.concatenate([*parts, tracker.finish(frames)])[:frames]


# Faults of recordings.

CLIPPED = 1e-3
"""Share of samples in runs at the largest value above which a recording counts as clipped."""

NOISY = 25.0
"""Decibels between speech and what goes on in its pauses below which a recording counts as noisy."""

PART = SAMPLE_RATE // 20
"""Samples of a part whose loudness counts."""


def speech_problems(speech: Wave) -> list[str]:
    """Faults of a recording (S,) at 16 kHz, each in a few words; empty if it has none."""
    peak = float(max(speech.max(initial=0), -speech.min(initial=0)))
    if peak < 1e-4:
        return ["is silent"]
    problems = []
    if _clipped(speech, 0.998 * peak) > CLIPPED:
        problems.append("is clipped: its loudest samples are cut off; record it at a lower level")
    apart = loudness_range(speech) if len(speech) >= 10 * PART else NOISY
    if apart < 6:
        problems.append("holds noise from beginning to end and perhaps no speech")
    elif apart < NOISY:
        problems.append(f"has noise {apart:.0f} dB below the speech; a cleaner recording moves the lips better")
    return problems


def loudness_range(speech: Wave) -> float:
    """Decibels between the loud parts of a recording (S,) at 16 kHz and its pauses; below 0 where it is silent."""
    if len(speech) < PART or float(np.abs(speech).max()) < 1e-4:
        return -1.0
    parts = speech[: len(speech) // PART * PART].reshape(-1, PART)
    powers = [  # by the minute, since speech may last hours
        np.square(some - some.mean(1, keepdims=True)).mean(1)
        for some in (np.asarray(parts[first : first + 1200], np.float64) for first in range(0, len(parts), 1200))
    ]
    levels = np.sort(10 * np.log10(np.concatenate(powers) + 1e-12))
    return float(np.percentile(levels, 80) - levels[: max(4, len(parts) // 20)].mean())


def _clipped(speech: Wave, level: float) -> float:
    """The share of samples at which three in a row reach a level; by the minute as well."""
    runs, piece = 0, 60 * SAMPLE_RATE
    for first in range(0, len(speech), piece):
        top = np.abs(speech[first : first + piece + 2]) >= level
        runs += int((top[2:] & top[1:-1] & top[:-2]).sum())
    return runs / max(1, len(speech) - 2)


class MouthAtRest:
    """Brings the mouth of one face to rest in pauses; the upper face keeps its motion.

    Where the gate is open, the motion is bit for bit the model's. At rest, the mouth is the template's (V, 3), as far
    as each vertex's weight (V,) says.
    """

    def __init__(
        self, gate: VoiceGate, template: npt.NDArray[np.floating], weights: npt.NDArray[np.float32], frame_rate: float
    ) -> None:
        self.gate, self.frame_rate = gate, frame_rate
        self.template, self.weights = np.asarray(template, np.float32), weights

    def openness(self) -> Openness:
        """The openness of a recording that has not begun yet."""
        return Openness(self.gate, self.frame_rate)

    def openness_of(self, speech: npt.NDArray[np.float32], frames: int) -> npt.NDArray[np.float32]:
        """The openness of each frame (frames,) of a recording (S,)."""
        return openness(speech, frames, self.frame_rate, self.gate)

    def apply(self, vertices: npt.NDArray[np.float32], openness: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Vertices (T, V, 3) with the mouth as far at rest as the openness (T,) says; themselves where all is open."""
        pausing = np.flatnonzero(openness < 1)
        if not len(pausing):
            return vertices
        result = np.array(vertices, np.float32)
        for frame in pausing:  # one at a time: all of them may be much memory
            result[frame] -= (1 - openness[frame]) * self.weights[:, None] * (vertices[frame] - self.template)
        return result
