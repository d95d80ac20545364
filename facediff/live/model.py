"""The model of a live performance, with its choices made, from which streams are started."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

from facediff.spaces.decoding import ChannelDecoder
from facediff.speech.voice_activity import USUAL_GATE, EnergyGate
from facediff.utils import SAMPLE_RATE

Array = npt.NDArray[np.float32]


class MotionStream(Protocol):
    """A stream: speech in pieces, to absolute points of the model's motion: vertices, or channels."""

    @property
    def made(self) -> int:
        """Frames that the model has generated so far; some of them may wait to be certain."""

    @property
    def heads(self) -> npt.NDArray[np.float64] | None:
        """How the head moved as a whole in the frames that were given last (m, 6); None if nothing moves it."""

    def feed(self, samples: Array, /) -> Array:
        """Take samples (n,) at 16 kHz, and give the frames (m, points, dims) that are certain now."""

    def finish(self) -> Array:
        """The frames (m, points, dims) that are left."""


@dataclass(frozen=True, eq=False)
class LiveModel:
    """A model that is ready to perform.

    Attributes:
        start: starts a stream at the beginning of speech.
        frame_rate: frames a second.
        neutral: the face at rest (V, 3).
        faces: triangles (F, 3); empty if there are none.
        unit: of length.
        look_ahead: seconds of speech that must arrive after a frame begins before it is certain, at most.
        hop: seconds of frames that become certain together.
        colours: of the vertices (V, 3); None if there are none.
        decoder: turns a stream's frames into vertices, where they are channels; None where they are vertices.
        metadata: model, corpus, licences, identity, style, seed.
    """

    start: Callable[[], MotionStream]
    frame_rate: float
    neutral: Array
    faces: npt.NDArray[np.int32]
    unit: str
    look_ahead: float
    hop: float
    colours: npt.NDArray[np.uint8] | None = None
    decoder: ChannelDecoder | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)

    @property
    def weights(self) -> tuple[str, ...]:
        """Names of the weights of ARKit's shapes that a stream's frames are; empty where they are something else."""
        arkit = self.decoder is not None and self.decoder.space.kind == "arkit"
        return self.decoder.space.channels if arkit and self.decoder is not None else ()

    def warm_up(self) -> None:
        """Animate silence for a moment, since the first window after opening a model is slow."""
        stream = self.start()
        stream.feed(np.zeros(round((self.look_ahead + self.hop + 0.1) * SAMPLE_RATE), np.float32))


def usual_gate(look_ahead: float) -> str:
    """The usual voice gate, but that it waits no longer than the windows, as ``read_gate`` takes it.

    Args:
        look_ahead: seconds of speech that the windows wait for.

    Example:
        >>> usual_gate(4.5)
        'energy'
        >>> usual_gate(0.2)
        'energy:attack=0.085,lead=0.085,ahead=0'
    """
    gate = EnergyGate()
    margin = look_ahead - 0.03  # the gate decides in steps of 10 ms
    if margin >= gate.ahead + gate.attack + gate.lead:
        return USUAL_GATE
    # A mouth that opens late is worse than a gate that does not know the noise yet: the opening goes first.
    attack = min(gate.attack, max(0.0, margin / 2))
    lead = min(gate.lead, max(0.0, margin - attack))
    ahead = min(gate.ahead, max(0.0, margin - attack - lead))
    return f"{USUAL_GATE}:attack={attack:.4g},lead={lead:.4g},ahead={ahead:.4g}"
