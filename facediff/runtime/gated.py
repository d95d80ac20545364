"""A stream of an exported model: samples in, absolute vertices out, with the mouth at rest in pauses."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.runtime.model import RuntimeStream
from facediff.speech.stream import AnimationStream
from facediff.speech.voice_activity import MouthAtRest

Array = npt.NDArray[np.float32]


class RuntimeVertices:
    """The absolute vertices of a stream's offsets.

    Args:
        stream: at the beginning of speech.
    """

    def __init__(self, stream: RuntimeStream) -> None:
        self.stream = stream
        self._template = stream.model.arrays["templates"][stream.face]

    @property
    def frames(self) -> int:
        """Frames that have been generated so far."""
        return self.stream.frames

    def feed(self, samples: Array) -> Array:
        """The frames (m, V, 3) that more speech (n,) at 16 kHz makes certain."""
        vertices: Array = self.stream.feed(samples)[0] + self._template
        return vertices

    def finish(self) -> Array:
        """The frames (m, V, 3) that are left."""
        vertices: Array = self.stream.finish()[0] + self._template
        return vertices


def gated_stream(stream: RuntimeStream) -> AnimationStream:
    """Vertices of speech that arrives in pieces, with the mouth at rest in pauses where the stream has a gate."""
    arrays, face = stream.model.arrays, stream.face
    rest = None
    if stream.gate is not None:
        template, weights = arrays["templates"][face], arrays["rest_weights"][face]
        rest = MouthAtRest(stream.gate, template, weights, stream.model.frame_rate)
    return AnimationStream(RuntimeVertices(stream), rest=rest)
