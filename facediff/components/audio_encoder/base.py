"""What every audio encoder is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.components.layers import frame_mask

SAMPLE_RATE = 16_000


class AudioEncoder(nn.Module, ABC):
    """Speech to one feature per motion frame.

    A clip's feature must not depend on how far it is padded, nor on the clips beside it.

    An encoder whose first part is frozen may let it be computed once per clip and kept on disk: it then overrides
    :meth:`frozen_key` and :meth:`frozen_features`, and takes their result as ``features`` and ``feature_lengths``,
    two further arguments of its :meth:`forward` that no other encoder is given.

    An encoder that looks at how loud the speech is takes it through :meth:`standardise`, so that a piece of a long
    recording is heard as loud as it is in the whole.
    """

    _level: tuple[float, float] | None = None

    @contextmanager
    def at_level(self, mean: float, deviation: float) -> Iterator[None]:
        """Within it, speech is standardised by this mean and standard deviation and not by its own."""
        before, self._level = self._level, (mean, deviation)
        try:
            yield
        finally:
            self._level = before

    def standardise(
        self, audio: Float[Tensor, "batch samples"], lengths: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch samples"]:
        """Speech of zero mean and unit variance, as :func:`standardise` makes it or by the level that is set."""
        if self._level is None:
            return standardise(audio, lengths)
        mean, deviation = self._level
        return (audio - mean) / deviation * frame_mask(lengths, audio.shape[1])

    def frozen_key(self) -> str | None:
        """A hash of all that decides :meth:`frozen_features`; None if nothing is frozen, or something is random."""
        return None

    def frozen_features(
        self, audio: Float[Tensor, "batch samples"], audio_lengths: Int[Tensor, " batch"]
    ) -> tuple[Float[Tensor, "batch steps channels"], Int[Tensor, " batch"]]:
        """What the frozen part makes of speech, and each clip's valid steps.

        Raises:
            NotImplementedError: if the encoder has no frozen part.
        """
        raise NotImplementedError(f"{type(self).__name__} has no frozen part")

    @abstractmethod
    def forward(
        self,
        audio: Float[Tensor, "batch samples"],
        audio_lengths: Int[Tensor, " batch"],
        frame_lengths: Int[Tensor, " batch"],
    ) -> Float[Tensor, "batch frames dim"]:
        """Encode.

        Args:
            audio: waveform at 16 kHz, mono, padded with zeros.
            audio_lengths: valid samples of each clip.
            frame_lengths: motion frames of each clip; they span the same time as its samples.

        Returns:
            features, ``frames = frame_lengths.max()``; zero on padding frames.
        """


class AudioEncoderFactory(Protocol):
    """Makes an audio encoder once the system's width is known."""

    def __call__(self, *, dim: int) -> AudioEncoder:
        """Make one with ``dim`` output channels."""
        ...


def standardise(
    audio: Float[Tensor, "batch samples"], lengths: Int[Tensor, " batch"]
) -> Float[Tensor, "batch samples"]:
    """Zero mean and unit variance over each clip's valid samples, zero on padding, as HuBERT's processor does."""
    mask = frame_mask(lengths, audio.shape[1])
    count = lengths[:, None].to(audio.dtype)
    mean = (audio * mask).sum(1, keepdim=True) / count
    variance = ((audio - mean).square() * mask).sum(1, keepdim=True) / count
    return (audio - mean) / (variance + 1e-7).sqrt() * mask
