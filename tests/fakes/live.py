"""Parts of a live performance without a model or a sound device."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np

from facediff.live.frames import Address, LiveFrame, Performance, Receiver
from facediff.live.model import LiveModel
from facediff.live.sources import Deliver, SpeechSource
from facediff.speech.audio import samples_for

VERTICES = 4
FRAME_RATE = 50.0
HOP, AHEAD = 4, 8  # frames


class FakeStream:
    """Frames whose first coordinate is their number, in bursts of a hop, after a look-ahead.

    Args:
        cost: seconds of computing for each second of speech.
    """

    heads: np.ndarray | None = None

    def __init__(self, cost: float = 0.0) -> None:
        self.cost, self.made, self.heard = cost, 0, 0

    def feed(self, samples: np.ndarray) -> np.ndarray:
        time.sleep(self.cost * len(samples) / 16_000)
        self.heard += len(samples)
        count = 0
        while self.heard >= samples_for(self.made + count + HOP + AHEAD, FRAME_RATE):
            count += HOP
        return self._frames(count)

    def finish(self) -> np.ndarray:
        return self._frames(round(self.heard * FRAME_RATE / 16_000) - self.made)

    def _frames(self, count: int) -> np.ndarray:
        made = np.zeros((count, VERTICES, 3), np.float32)
        made[:, 0, 0] = np.arange(self.made, self.made + count)
        self.made += count
        return made


def fake_model(start: Callable[[], Any] = FakeStream) -> LiveModel:
    return LiveModel(
        start=start,
        frame_rate=FRAME_RATE,
        neutral=np.zeros((VERTICES, 3), np.float32),
        faces=np.array([[0, 1, 2], [1, 3, 2]], np.int32),
        unit="m",
        look_ahead=(HOP + AHEAD) / FRAME_RATE,
        hop=HOP / FRAME_RATE,
        metadata={"licence": "none"},
    )


class Spoken(SpeechSource):
    """Samples in pieces of 10 ms in real time, by a clock of its own; afterwards an error, if there is one.

    Args:
        seconds: of speech.
        pauses: seconds without speech before a piece, by its number.
        error: that ends it.
    """

    name = "fake"

    def __init__(self, seconds: float, pauses: dict[int, float] | None = None, error: Exception | None = None) -> None:
        self.pieces, self.pauses, self.error = round(seconds * 100), pauses or {}, error

    def run(self, deliver: Deliver, stopped: threading.Event) -> None:
        due = time.monotonic()
        for piece in range(self.pieces):
            due += 0.01 + self.pauses.get(piece, 0.0)
            if stopped.wait(max(0.0, due - time.monotonic())):
                return
            deliver(np.full(160, 0.1, np.float32), time.monotonic())
        if self.error is not None:
            raise self.error


class Kept(Receiver):
    """Keeps frames with the time at which they came, and speech.

    Args:
        seconds: that it takes for a frame.
        error: that it raises for the third frame.
    """

    def __init__(self, seconds: float = 0.0, error: BaseException | None = None, *, weights: bool = False) -> None:
        super().__init__(Address("kept:", "kept"))
        self.seconds, self.error, self.needs_weights = seconds, error, weights
        self.frames: list[LiveFrame] = []
        self.times: list[float] = []
        self.speech: list[tuple[np.ndarray, float]] = []
        self.performance: Performance | None = None
        self.closed = 0

    def open(self, performance: Performance) -> None:
        self.performance = performance

    def send(self, frame: LiveFrame) -> None:
        time.sleep(self.seconds)
        self.frames.append(frame)
        self.times.append(time.monotonic())
        if self.error is not None and len(self.frames) == 3:
            raise self.error

    def hear(self, speech: np.ndarray, start: float) -> None:
        self.speech.append((speech, start))

    def close(self) -> None:
        self.closed += 1

    def status(self) -> str:
        return f"{len(self.frames)} frames"


class PortAudioError(Exception):
    """What sounddevice raises."""


def device(name: str, inputs: int, outputs: int, rate: float = 48_000.0) -> dict[str, Any]:
    return {
        "name": name,
        "max_input_channels": inputs,
        "max_output_channels": outputs,
        "default_samplerate": rate,
    }


class FakeSound(SimpleNamespace):
    """The part of sounddevice that is used, with devices of its own; callbacks are called by hand or by a thread.

    Args:
        devices: as ``query_devices`` gives them.
        refuse: what opening a stream raises.
    """

    def __init__(self, *devices: dict[str, Any], refuse: Exception | None = None, usual: int = 0) -> None:
        super().__init__(
            PortAudioError=PortAudioError,
            default=SimpleNamespace(device=(usual, usual)),
            query_devices=lambda: devices,
            InputStream=lambda **words: self._open(**words),
        )
        self.refuse, self.opened = refuse, list[Any]()

    def _open(self, **words: Any) -> Any:  # noqa: ANN401
        if self.refuse is not None:
            raise self.refuse
        self.opened.append(FakeStreamOfSound(**words))
        return self.opened[-1]


class FakeStreamOfSound(SimpleNamespace):
    """A stream of sounddevice; as a context it is open until it is left."""

    active = True
    closed = False

    def __enter__(self) -> FakeStreamOfSound:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def stop(self) -> None:
        self.active = False

    def close(self) -> None:
        self.closed = True
