"""Chosen by name around a model: augmentation, voice gate, acting, synthesiser, and a receiver of live frames."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.data.augmentation import Augmentation
from facediff.editing.acting import Acting, Performer
from facediff.live import Address, LiveFrame, Performance, Receiver
from facediff.speech.espeak import SpokenPhoneme, Utterance
from facediff.speech.voice_activity import Listener, VoiceGate
from facediff.synthetic.voices import Delivery, Synthesiser


class Reversed(Augmentation):
    """The other sign of every sample, as from a microphone that is wired the other way round."""

    def change(self, speech: npt.NDArray[np.float32], random: np.random.Generator) -> npt.NDArray[np.floating]:
        """Change the sign."""
        return -speech


class AboveLevel(VoiceGate):
    """Speech is what is louder than a fixed level.

    Args:
        level: root mean square of a step, from 0 to 1 of full scale.
    """

    def __init__(self, *, level: float = 0.01) -> None:
        super().__init__()
        self.level = level

    def listener(self) -> Listener:
        """A detector without memory."""
        return _AboveLevelListener(self.level)


class _AboveLevelListener(Listener):
    def __init__(self, level: float) -> None:
        self.level = level

    def hear(self, steps: npt.NDArray[np.float64]) -> list[bool]:
        """Decide on every step immediately."""
        return [bool(step) for step in np.sqrt(np.square(steps).mean(1)) > self.level] if len(steps) else []

    def finish(self) -> list[bool]:
        """Nothing is left."""
        return []


class RaisedBrows(Acting):
    """Brows that stay raised by a millimetre.

    Args:
        brows: millimetres.
    """

    def __init__(self, *, brows: float = 1.0) -> None:
        self.brows = brows

    def performer(self, frame_rate: float, seed: int) -> Performer:
        """The same for every recording."""
        return _RaisedBrows(self.brows)


class _RaisedBrows(Performer):
    def __init__(self, brows: float) -> None:
        self.brows = brows

    def feed(self, samples: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
        """Frames wait for the end."""
        return np.zeros((0, 5))

    def finish(self, frames: int) -> npt.NDArray[np.float64]:
        """Brows, then lids and the angles of the head, which stay at rest."""
        return np.tile([self.brows, 0.0, 0.0, 0.0, 0.0], (frames, 1))


class Hummer(Synthesiser):
    """Hums an m for as long as a text has letters."""

    install = "it is part of this package"

    @classmethod
    def voices(cls) -> list[str]:
        """One voice."""
        return ["plain"]

    def speak(self, text: str, delivery: Delivery = Delivery()) -> Utterance:  # noqa: B008 - frozen
        """A tone of 120 Hz, a twentieth of a second for each letter."""
        seconds = 0.05 * max(len(text), 2) / delivery.rate
        times = np.arange(round(16_000 * seconds)) / 16_000
        samples = 0.3 * np.sin(2 * np.pi * 120.0 * 2.0 ** (delivery.pitch / 12.0) * times)
        return Utterance(samples.astype(np.float32), (SpokenPhoneme(0.0, seconds, "m"),))


class Counter(Receiver):
    """Counts frames, and prints their number at the end."""

    def __init__(self, address: Address) -> None:
        super().__init__(address)
        self.frames = 0

    def open(self, performance: Performance) -> None:
        """Start at zero."""
        self.frames = 0

    def send(self, frame: LiveFrame) -> None:
        """One more."""
        self.frames += 1

    def close(self) -> None:
        """Print."""
        print(f"{self.frames} frames")
