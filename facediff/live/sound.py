"""Speech on a sound device, delayed so that it is heard when its frames are seen."""

from __future__ import annotations

import threading
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.live.frames import Address, LiveFrame, Performance, Receiver
from facediff.live.sources import USUAL, find_device, sound_library
from facediff.live.timing import Pacer, SpokenClock
from facediff.speech.resampling import Resampler
from facediff.utils import SAMPLE_RATE

Array = npt.NDArray[np.float32]

KEPT = 30.0
"""Seconds of speech that are kept: more than any delay."""

APART = 0.03
"""Seconds by which sound and face may drift apart before the sound jumps."""


class SoundOut(Receiver):
    """Plays the speech of a performance on a sound device; it ignores frames.

    Args:
        device: number or part of the name; ``default`` for the system's choice.
    """

    def __init__(self, device: str = USUAL) -> None:
        super().__init__(Address("sound", "sound"))
        self._sound = sound_library("playing speech")
        self._device, about = find_device(self._sound, device, "output")
        self.name = f"sound device {about['name']}"
        self.rate = round(float(about["default_samplerate"]))
        self.jumps = 0
        self._convert = Resampler(SAMPLE_RATE, self.rate)
        self._lock = threading.Lock()
        self._kept = np.zeros(round(KEPT * self.rate), np.float32)  # a ring: sample n lies at n modulo its length
        self._end = 0  # samples so far
        self._place: int | None = None  # the next one to be played
        self._clock: SpokenClock | None = None
        self._pacer: Pacer | None = None
        self._stream: Any = None

    def follow(self, clock: SpokenClock, pacer: Pacer) -> None:
        """Play by these clocks: a moment of speech is heard when its frames are due."""
        self._clock, self._pacer = clock, pacer

    def open(self, performance: Performance) -> None:
        """Begin to play silence."""
        try:
            self._stream = self._sound.OutputStream(
                device=self._device,
                channels=1,
                samplerate=self.rate,
                dtype="float32",
                latency="low",
                callback=self._play,
            )
            self._stream.start()
        except (self._sound.PortAudioError, OSError, ValueError) as error:
            raise FaceDiffError(
                f"{self.name}: cannot be opened ({error}); close what uses it, or choose another device"
            ) from error

    def hear(self, speech: Array, start: float) -> None:
        """Keep speech until it is due."""
        converted = self._convert(speech)
        with self._lock:
            at = (self._end + np.arange(len(converted))) % len(self._kept)
            self._kept[at] = converted
            self._end += len(converted)

    def send(self, frame: LiveFrame) -> None:
        """Nothing: sound has no frames."""

    def close(self) -> None:
        """Stop playing."""
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.stop()
            stream.close()

    def status(self) -> str:
        """How often the sound had to jump to stay in time with the face."""
        return f"{self.jumps} jumps" if self.jumps else ""

    def _play(self, out: Array, count: int, clock: Any, status: Any) -> None:  # noqa: ANN401 - of PortAudio
        """Fill a block that will be heard in a moment; runs in PortAudio's thread."""
        out[:] = 0
        if self._clock is None or self._pacer is None or self._pacer.delay is None:
            return
        waits = clock.outputBufferDacTime - clock.currentTime
        heard_at = time.monotonic() + (waits if 0 < waits < 1 else 0.0)
        due = round((heard_at - self._pacer.delay - self._clock.offset) * self.rate)
        if self._place is None or abs(self._place - due) > APART * self.rate:
            self.jumps += self._place is not None
            self._place = due
        at = self._place + np.arange(count)
        with self._lock:
            available = (at >= max(0, self._end - len(self._kept))) & (at < self._end)
            out[available, 0] = self._kept[at[available] % len(self._kept)]
        self._place += count
