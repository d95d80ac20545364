"""A stream of an exported model with its voice gate: samples in, finished vertices out."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.runtime.model import RuntimeStream
from facediff.speech.voice_activity import toward_rest

Array = npt.NDArray[np.float32]


class GatedStream:
    """Vertices of speech that arrives in pieces, with the mouth at rest in pauses where the stream has a gate.

    Args:
        stream: which has not heard anything yet.
    """

    def __init__(self, stream: RuntimeStream) -> None:
        self.stream = stream
        self._openness = stream.openness()
        arrays, face = stream.model.arrays, stream.face
        self._template, self._weights = arrays["templates"][face], arrays["rest_weights"][face]
        # Frames whose openness is not certain yet, and openness whose frames are not there yet.
        self._waiting = np.zeros((0, *self._template.shape), np.float32)
        self._opened = np.zeros(0, np.float32)

    @property
    def made(self) -> int:
        """Frames that the model has generated so far; some of them may wait for the gate."""
        return self.stream.frames

    def feed(self, samples: Array) -> Array:
        """Hear samples (n,) at 16 kHz, and give the frames (m, V, 3) that are certain now; m may be 0."""
        made = self.stream.feed(samples)
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.feed(samples)])
        return self._certain(made)

    def finish(self) -> Array:
        """The frames (m, V, 3) that are left.

        Raises:
            FaceDiffError: if the speech was shorter than a frame.
        """
        made = self.stream.finish()
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.finish(self.stream.frames)])
        return self._certain(made)

    def _certain(self, offsets: Array) -> Array:
        """With more offsets (1, n, V, 3), the frames of which everything is known."""
        vertices = offsets[0] + self._template
        if self._openness is None:
            return vertices
        self._waiting = np.concatenate([self._waiting, vertices])
        count = min(len(self._waiting), len(self._opened))
        ready, opened = self._waiting[:count], self._opened[:count]
        self._waiting, self._opened = self._waiting[count:], self._opened[count:]
        return toward_rest(ready, opened, self._template, self._weights)
