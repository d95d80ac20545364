"""A performance without a model: a small face whose weights are known in every frame."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import numpy as np
import pytest

from facediff.live.frames import LiveFrame, Performance, Receiver, open_receiver
from facediff.spaces.arkit import ARKIT

VERTICES = 40
FRAME_RATE = 30.0


@pytest.fixture(scope="session")
def performance() -> Performance:
    random = np.random.default_rng(0)
    neutral = random.normal(size=(VERTICES, 3)).astype(np.float32) * 0.1
    faces = np.arange(VERTICES - VERTICES % 3, dtype=np.int32).reshape(-1, 3)
    return Performance(FRAME_RATE, neutral, faces, subject="Ann", shapes=ARKIT, metadata={"licence": "CC0"})


def weights_of(index: int) -> np.ndarray:
    """Weights (52,) of a frame, each another number."""
    return np.random.default_rng(index).uniform(size=len(ARKIT)).astype(np.float32)


def frame(index: int, *, dropped: int = 0) -> LiveFrame:
    offsets = np.random.default_rng(index).normal(size=(VERTICES, 3)).astype(np.float32) * 0.01
    return LiveFrame(index, index / FRAME_RATE, time.monotonic() - 0.1, offsets, weights_of(index), dropped)


Opened = Callable[[str], Receiver]


@pytest.fixture
def opened(performance: Performance) -> Iterator[Opened]:
    """Opens receivers by their addresses, and closes them at the end."""
    receivers: list[Receiver] = []

    def open_one(text: str) -> Receiver:
        receivers.append(open_receiver(text))
        receivers[-1].open(performance)
        return receivers[-1]

    yield open_one
    for receiver in receivers:
        receiver.close()
