"""Which frame of one person's reading of a sentence goes with which of another's."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import torch
from jaxtyping import Float
from torch import Tensor

from facediff.components.audio_encoder.mel import mel_filters
from facediff.data import Batch
from facediff.data.audio import SAMPLE_RATE
from facediff.errors import MissingExtraError

N_MELS = 40
N_FFT = 512
N_CEPSTRA = 13
BAND = 0.25
"""How far two readings may be apart in time, as a share of the longer one, after both are stretched to one length."""


def cepstra(audio: Float[Tensor, " samples"], frames: int, frame_rate: float) -> npt.NDArray[np.float64]:
    """Speech features (frames, 2 · 13) that depend little on the voice: standardised cepstra and their slopes.

    The mean and the variance over the sentence, which tell voice and microphone rather than sounds, are taken out.
    """
    hop = SAMPLE_RATE / frame_rate
    padded = torch.nn.functional.pad(audio.double(), (N_FFT // 2, N_FFT // 2 + int(hop)))
    starts = [round(hop * (frame + 0.5)) for frame in range(frames)]
    stretch = torch.stack([padded[start : start + N_FFT] for start in starts])
    power = torch.fft.rfft(stretch * torch.hann_window(N_FFT, dtype=torch.float64)).abs().square()
    energy = torch.log(power @ mel_filters(N_MELS, N_FFT, 60.0, 7600.0).double().T + 1e-6)
    place = (torch.arange(N_MELS, dtype=torch.float64) + 0.5) * torch.pi / N_MELS
    features = energy @ torch.cos(place[:, None] * torch.arange(N_CEPSTRA, dtype=torch.float64))
    features = torch.cat([features, torch.gradient(features, dim=0)[0]], 1) if frames > 1 else features.repeat(1, 2)
    spread = features.std(0, correction=0).clamp_min(1e-6)
    return ((features - features.mean(0)) / spread).numpy()


def align(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """For each frame of ``first`` the frame of ``second`` that goes with it, by dynamic time warping.

    Args:
        first: features (T, C).
        second: features (U, C).

    Returns:
        indices (T,) into ``second``, never falling; where several frames go with one, the middle one.

    Raises:
        MissingExtraError: if dtaidistance is not installed.
    """
    try:
        from dtaidistance import dtw_ndim
        from dtaidistance.dtw import best_path
    except ImportError as error:
        raise MissingExtraError("dtaidistance", "mesh", "aligning two readings of one sentence") from error
    window = round(BAND * max(len(first), len(second))) + abs(len(first) - len(second)) + 1
    _, costs = dtw_ndim.warping_paths_fast(np.ascontiguousarray(first), np.ascontiguousarray(second), window=window)
    partners: list[list[int]] = [[] for _ in first]
    for here, there in best_path(costs):
        partners[here].append(there)
    return np.array([there[len(there) // 2] for there in partners], np.int64)


class Readings:
    """Alignments of pairs of clips, each computed once and kept.

    Args:
        frame_rate: motion frames a second.
    """

    def __init__(self, frame_rate: float) -> None:
        self.frame_rate = frame_rate
        self._found: dict[tuple[str, str], Tensor] = {}

    def frames(self, batch: Batch, clip: int, other: int) -> Tensor:
        """For each valid frame of a clip of the batch the frame of another one, indices (frames,)."""
        names = (batch.names[clip], batch.names[other])
        if names not in self._found:
            features = [self._features(batch, each) for each in (clip, other)]
            self._found[names] = torch.from_numpy(align(*features))
        return self._found[names]

    def _features(self, batch: Batch, clip: int) -> npt.NDArray[np.float64]:
        audio = batch.audio[clip, : int(batch.audio_lengths[clip])].float().cpu()
        return cepstra(audio, int(batch.frame_lengths[clip]), self.frame_rate)
