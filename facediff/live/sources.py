"""Where speech comes from: a microphone, a recording that is played in real time, or samples on standard input.

A source runs in a thread of its own, hands over pieces of 16 kHz as they come, and ends by itself or when stopped.
"""

from __future__ import annotations

import sys
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError, choices
from facediff.speech.pcm import pcm
from facediff.speech.resampling import Resampler
from facediff.utils import SAMPLE_RATE

Speech = npt.NDArray[np.float32]
"""Samples (n,), full scale 1."""

Deliver = Callable[[Speech, float], None]
"""Takes samples at 16 kHz, and :func:`time.monotonic` when the last of them arrived."""

PIECE = 0.01
"""Seconds of a recording that are played at a time."""

AHEAD = 0.25
"""Seconds by which samples of a pipe may be ahead of the clock: a recorder's buffer at the start of this program."""

FASTER = 1.005
"""Samples of a pipe are taken at most so much faster than they are played: more than the clocks of sound cards differ,
so that a recorder is never held up, while a file that is sent through a pipe is played in real time."""

USUAL = "default"
"""In place of a device: the one that the system chooses."""

SILENT = 5.0
"""Seconds without a sample after which a microphone is gone."""


class SpeechSource(ABC):
    """Speech that arrives.

    Attributes:
        name: what reports call it.
    """

    name: str

    @abstractmethod
    def run(self, deliver: Deliver, stopped: threading.Event) -> None:
        """Hand over all speech, as it comes, until it ends or is stopped."""


class Played(SpeechSource):
    """A recording in real time, as if it were spoken now.

    Args:
        path: of any format, rate and number of channels that :func:`~facediff.speech.audio.read_speech` takes.
    """

    def __init__(self, path: Path) -> None:
        from facediff.speech.audio import read_speech

        self.name = str(path)
        self.samples = read_speech(path)

    def run(self, deliver: Deliver, stopped: threading.Event) -> None:
        """Hand over a piece whenever its last sample would have been spoken."""
        start = time.monotonic()
        size = round(PIECE * SAMPLE_RATE)
        for first in range(0, len(self.samples), size):
            piece = self.samples[first : first + size]
            if stopped.wait(max(0.0, start + (first + len(piece)) / SAMPLE_RATE - time.monotonic())):
                return
            deliver(piece, time.monotonic())


class Pcm(SpeechSource):
    """Samples of 16 bits, mono, little endian, on standard input.

    Args:
        rate: samples a second.
    """

    name = "standard input"

    def __init__(self, rate: int = SAMPLE_RATE) -> None:
        if sys.stdin is None or sys.stdin.closed or sys.stdin.isatty():
            raise FaceDiffError("standard input: is closed or a terminal; send 16-bit mono samples, as from arecord")
        self._stream = sys.stdin.buffer
        self.rate = rate
        self._convert = Resampler(rate, SAMPLE_RATE)

    def run(self, deliver: Deliver, stopped: threading.Event) -> None:
        """Hand over the samples, no faster than they are spoken."""
        read, start = 0, 0.0
        for samples in pcm(self._stream, self.rate):
            timestamp = time.monotonic()
            start = start or timestamp
            read += len(samples)
            early = start + read / self.rate / FASTER - AHEAD - timestamp
            if stopped.wait(max(0.0, early)):
                return
            deliver(self._convert(samples), time.monotonic() - self._convert.delay)
        if not read:
            raise FaceDiffError("standard input: ended before any sample came; send 16-bit mono samples to it")
        deliver(self._convert(np.zeros(0, np.float32), True), time.monotonic())


class Microphone(SpeechSource):
    """A sound device of this machine, through PortAudio.

    Args:
        device: number or part of the name; ``default`` for the system's choice.
    """

    def __init__(self, device: str = USUAL) -> None:
        self._sound = sound_library()
        self._device, about = find_device(self._sound, device)
        self.rate = round(float(about["default_samplerate"]))
        self.name = f"microphone {about['name']}"

    def run(self, deliver: Deliver, stopped: threading.Event) -> None:
        """Hand over blocks as PortAudio gives them, in its thread."""
        convert, latest, broken = Resampler(self.rate, SAMPLE_RATE), [time.monotonic()], list[Exception]()

        def heard(block: npt.NDArray[np.float32], count: int, clock: Any, status: Any) -> None:  # noqa: ANN401
            timestamp = time.monotonic()
            latest[0] = timestamp
            # The block was recorded before it is handed over; a driver that does not know when says 0.
            waited = clock.currentTime - clock.inputBufferAdcTime - count / self.rate
            arrived = timestamp - waited if clock.inputBufferAdcTime and 0 < waited < 1 else timestamp
            try:
                deliver(convert(block[:, 0].copy()), arrived - convert.delay)
            except Exception as error:  # noqa: BLE001 - raised in the thread that waits; PortAudio would only print it
                broken.append(error)

        try:
            with self._sound.InputStream(
                device=self._device,
                channels=1,
                samplerate=self.rate,
                dtype="float32",
                latency="low",
                callback=heard,
            ) as stream:
                while not stopped.wait(0.1):
                    if broken:
                        raise broken[0]
                    if not stream.active or time.monotonic() - latest[0] > SILENT:
                        raise FaceDiffError(f"{self.name}: gives no sound any more; connect it again")
        except (self._sound.PortAudioError, OSError, ValueError) as error:
            raise FaceDiffError(
                f"{self.name}: cannot be opened ({error}); close what uses it, or choose another device"
            ) from error


def sound_library() -> Any:  # noqa: ANN401 - a module without types
    """The library that speaks to sound devices."""
    try:
        import sounddevice
    except ImportError as error:
        raise MissingExtraError("sounddevice", "live", "a microphone") from error
    except OSError as error:  # its package for Linux comes without PortAudio
        raise FaceDiffError(
            "--microphone needs PortAudio, which is not installed; install it (apt-get install libportaudio2), or give "
            "a recording or samples on standard input"
        ) from error
    return sounddevice


def find_device(library: Any, device: str) -> tuple[int, dict[str, Any]]:  # noqa: ANN401
    """The number and the facts of an input device.

    Args:
        library: of :func:`sound_library`.
        device: its number or a part of its name; ``default`` for the system's choice.
    """
    try:
        devices = list(library.query_devices())
    except (library.PortAudioError, OSError) as error:
        raise FaceDiffError(f"--microphone: no sound device can be asked for ({error}); give a recording") from error
    fit = {number: facts for number, facts in enumerate(devices) if facts["max_input_channels"] > 0}
    if not fit:
        raise FaceDiffError("--microphone: there is no input device; connect one, or give a recording")
    if device == USUAL:
        default = library.default.device[0]
        number = default if default in fit else next(iter(fit))
        return number, fit[number]
    matches = [
        number for number, facts in fit.items() if device == str(number) or device.lower() in facts["name"].lower()
    ]
    exact = [number for number in matches if device in (str(number), fit[number]["name"])]
    if len(matches) == 1 or exact:
        return (exact or matches)[0], fit[(exact or matches)[0]]
    names = [f"{number}: {facts['name']}" for number, facts in fit.items()]
    problem = "several devices are called so" if matches else "there is no input device of this name or number"
    raise FaceDiffError(f"--microphone {device}: {problem}; {choices(device, names)}")
