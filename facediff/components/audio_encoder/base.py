"""What every audio encoder is."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Protocol

from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.components.layers import frame_mask

SAMPLE_RATE = 16_000


class AudioEncoder(nn.Module, ABC):
    """Speech to one feature per motion frame.

    A clip's feature must not depend on how far it is padded, nor on the clips beside it.
    """

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
