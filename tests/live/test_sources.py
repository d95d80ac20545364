"""Sources of speech: a recording and a pipe in real time, and a microphone through a made-up sound library.

No sound device is used: what stands for ``sounddevice`` here has the part of its interface that is used.
"""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import soundfile

from facediff.errors import FaceDiffError
from facediff.live.sources import Microphone, Pcm, Played, SpeechSource
from tests.fakes.live import FakeSound, device
from tests.fakes.simulated_time import SimulatedTime
from tests.fakes.waiting import PATIENCE, wait_until


def heard(source: SpeechSource, stopped: threading.Event | None = None) -> tuple[np.ndarray, np.ndarray, list[float]]:
    """All samples of a source, how many each piece has, and when each piece came, from the start."""
    pieces: list[np.ndarray] = []
    times: list[float] = []
    clock = SimulatedTime()
    began = clock.monotonic()

    def deliver(samples: np.ndarray, at: float) -> None:
        pieces.append(samples)
        times.append(at - began)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("facediff.live.sources.time", clock)
        source.run(deliver, stopped or clock.Event())  # type: ignore[arg-type]
    return np.concatenate(pieces), np.array([len(piece) for piece in pieces]), times


def test_recording_is_played_in_real_time(tmp_path: Path) -> None:
    wave = np.sin(np.arange(22_050 // 2) / 9)
    soundfile.write(tmp_path / "a.wav", np.stack([wave, wave], 1), 22_050)  # another rate, and two channels
    source = Played(tmp_path / "a.wav")
    samples, counts, times = heard(source)
    assert np.array_equal(samples, source.samples)
    assert len(samples) == 8000
    assert np.allclose(times, np.cumsum(counts) / 16_000)


@pytest.fixture
def standard_input(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[bytes], None]]:
    """Makes a pipe with bytes in it, that is closed at its other end, standard input."""
    with ExitStack() as stack:

        def put(data: bytes) -> None:
            out, into = os.pipe()
            threading.Thread(target=lambda: (os.write(into, data), os.close(into)), daemon=True).start()
            monkeypatch.setattr(sys, "stdin", stack.enter_context(os.fdopen(out)))

        yield put


def test_file_through_a_pipe_is_played_in_real_time(standard_input: Callable[[bytes], None]) -> None:
    wave = (3000 * np.sin(np.arange(32_000) / 9)).astype("<i2")
    standard_input(wave.tobytes() + b"\0")  # with half a sample at its end
    samples, counts, times = heard(Pcm(48_000))
    assert abs(len(samples) - 32_000 / 3) < 200
    ahead = np.cumsum(counts) / 16_000 - times
    assert 0.1 < ahead.max() < 0.3  # what a recorder may have kept
    assert times[-1] > 0.4


CARDS = (device("Line out", 0, 2), device("Webcam", 1, 0, 32_000.0), device("USB Mic", 2, 2), device("USB Mic 2", 1, 0))


def library(monkeypatch: pytest.MonkeyPatch, *cards: dict[str, Any], **words: Any) -> FakeSound:  # noqa: ANN401
    made = FakeSound(*cards, **words)
    monkeypatch.setitem(sys.modules, "sounddevice", made)  # type: ignore[arg-type]
    return made


@pytest.mark.parametrize(
    ("wanted", "name"),
    [("default", "USB Mic"), ("1", "Webcam"), ("webc", "Webcam"), ("USB Mic", "USB Mic"), ("mic 2", "USB Mic 2")],
)
def test_microphone_is_found_by_number_or_name(wanted: str, name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    library(monkeypatch, *CARDS, usual=2)
    assert Microphone(wanted).name == f"microphone {name}"


def test_microphone_hands_over_blocks_with_the_time_at_which_they_were_spoken(monkeypatch: pytest.MonkeyPatch) -> None:
    sound, stopped = library(monkeypatch, *CARDS), threading.Event()
    pieces: list[tuple[np.ndarray, float]] = []
    source = Microphone("Webcam")
    monkeypatch.setattr("facediff.live.sources.time", SimpleNamespace(monotonic=lambda: 100.0))
    thread = threading.Thread(target=source.run, args=(lambda *piece: pieces.append(piece), stopped))
    thread.start()
    wait_until(lambda: sound.opened)
    [stream] = sound.opened
    assert (stream.samplerate, stream.channels) == (32_000, 1)
    block = np.sin(np.arange(3200) / 20)[:, None].astype(np.float32)
    for _ in range(3):
        # PortAudio says that the first sample was recorded 0.15 s ago, so the last one 0.05 s ago.
        stream.callback(block, 3200, SimpleNamespace(currentTime=7.15, inputBufferAdcTime=7.0), None)
        assert pieces[-1][1] == pytest.approx(100 - 0.05 - 1 / 480, abs=0.001)  # 2 ms are held back
    stream.callback(block, 3200, SimpleNamespace(currentTime=0.0, inputBufferAdcTime=0.0), "input overflow")
    assert pieces[-1][1] == pytest.approx(100, abs=0.003)
    stopped.set()
    thread.join(PATIENCE)
    assert stream.closed
    assert sum(len(samples) for samples, _ in pieces) == 4 * 1600 - 32


def test_microphone_that_is_unplugged_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    sound = library(monkeypatch, *CARDS)

    def pull() -> None:
        wait_until(lambda: sound.opened)
        sound.opened[0].stop()

    threading.Thread(target=pull, daemon=True).start()
    with pytest.raises(FaceDiffError, match="Webcam"):
        Microphone("Webcam").run(lambda *_: None, threading.Event())
