"""Speech that arrives in pieces to finished frames, from top to bottom: a model's windows, pauses, acting, controls.

Needs no PyTorch: a trained model and an exported one are followed by the same steps as a recording is.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
import numpy.typing as npt

from facediff.speech.audio import resampler
from facediff.speech.voice_activity import MouthAtRest
from facediff.utils import SAMPLE_RATE

Array = npt.NDArray[np.float32]
Acted = npt.NDArray[np.float64]
Finish = Callable[[Array, int, Acted | None], tuple[Array, Acted | None]]
"""Makes vertices (m, V, 3) of frames of a model's points (m, points, dims), the first of which has a number, with what
acting does in each of them (m, 5): decoding, controls. And how the head moves in them as a whole (m, 6), if it does, as
:attr:`facediff.animation.Animation.head`."""


class VertexGenerator(Protocol):
    """A model that generates absolute points of one sample while speech arrives: vertices, or channels."""

    @property
    def frames(self) -> int:
        """Frames that have been generated so far."""

    def feed(self, samples: Array, /) -> Array:
        """Take speech (n,) at 16 kHz, and give the frames (m, points, dims) that it makes certain."""

    def finish(self) -> Array:
        """The frames (m, points, dims) that are left."""


class ActingStream(Protocol):
    """Acts to speech while it arrives."""

    def feed(self, samples: Array, /) -> Acted:
        """What acting does in the frames (m, 5) that more speech makes certain."""

    def finish(self, frames: int, /) -> Acted:
        """What it does in the frames that are left, of so many in all."""


class AnimationStream:
    """Animates speech of any length and any sample rate while it arrives; memory does not grow with its length.

    The frames are those of the recording as a whole, however the speech is cut into pieces.

    Args:
        generator: the model at the beginning of speech.
        rest: brings the mouth to rest in pauses; None for the model's own motion there.
        performer: acts; None for no acting.
        finish: makes vertices of the model's frames, with the animation controls; None for the frames as they are.
        rate: sample rate of the speech.

    Attributes:
        heads: how the head moved as a whole in the frames that were given last (m, 6); None if nothing moves it.
    """

    heads: Acted | None = None

    def __init__(
        self,
        generator: VertexGenerator,
        *,
        rest: MouthAtRest | None = None,
        performer: ActingStream | None = None,
        finish: Finish | None = None,
        rate: int = SAMPLE_RATE,
    ) -> None:
        self.generator, self._rest, self._performer, self._finish = generator, rest, performer, finish
        self._convert = None if rate == SAMPLE_RATE else resampler(rate)
        self._openness = None if rest is None else rest.openness()
        # Frames of the model, how far their mouths may be open, and how they are acted: each of the three becomes
        # certain at a time of its own, and what comes first waits here for the others.
        self._vertices: Array | None = None
        self._opened = np.zeros(0, np.float32)
        self._acted = np.zeros((0, 5))
        self._finished = 0

    @property
    def made(self) -> int:
        """Frames that the model has generated so far; some of them may wait for the voice gate or for acting."""
        return self.generator.frames

    def feed(self, samples: Array) -> Array:
        """Take samples (n,), and give the frames (m, V, 3) that are certain now; m may be 0."""
        self.heads = None
        return self._feed(samples if self._convert is None else self._convert(samples, False))

    def finish(self) -> Array:
        """The frames (m, V, 3) that are left."""
        self.heads = None
        resampled = [] if self._convert is None else [self._feed(self._convert(np.zeros(0, np.float32), True))]
        vertices = self.generator.finish()
        frames = self.generator.frames
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.finish(frames)])
        if self._performer is not None:
            self._acted = np.concatenate([self._acted, self._performer.finish(frames)])
        return np.concatenate([*resampled, self._certain(vertices)])

    def _feed(self, speech: Array) -> Array:
        """The frames that are certain after more speech (n,) at 16 kHz."""
        vertices = self.generator.feed(speech)
        if self._openness is not None:
            self._opened = np.concatenate([self._opened, self._openness.feed(speech)])
        if self._performer is not None:
            self._acted = np.concatenate([self._acted, self._performer.feed(speech)])
        return self._certain(vertices)

    def _certain(self, vertices: Array) -> Array:
        """With more frames of the model, those of which everything is known, finished."""
        if self._vertices is not None and len(self._vertices):
            vertices = np.concatenate([self._vertices, vertices])
        count = len(vertices)
        if self._openness is not None:
            count = min(count, len(self._opened))
        if self._performer is not None:
            count = min(count, len(self._acted))
        self._vertices, vertices = vertices[count:], vertices[:count]
        opened, self._opened = self._opened[:count], self._opened[count:]
        acted, self._acted = self._acted[:count], self._acted[count:]
        if self._rest is not None:
            vertices = self._rest.apply(vertices, opened)
        if self._finish is not None:
            vertices, heads = self._finish(vertices, self._finished, None if self._performer is None else acted)
            if heads is not None:  # a piece without a frame has none
                self.heads = heads if self.heads is None else np.concatenate([self.heads, heads])
        self._finished += count
        return vertices
