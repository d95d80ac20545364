"""Cepstra of speech, which depend little on the voice, and by them the alignment of two recordings of a sentence."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from facediff.errors import needs_extra
from facediff.utils import SAMPLE_RATE

N_MELS = 40
N_FFT = 512
N_CEPSTRA = 13
BAND = 0.25
"""How far two recordings may be apart in time, as a share of the longer one, after both are stretched to one length."""


def mel_filters(n_mels: int, n_fft: int, low: float, high: float) -> npt.NDArray[np.float32]:
    """Triangular filters (mels, bins) of unit area in Hz, equally spaced in mel, 2595·log10(1 + f/700), at 16 kHz.

    The scale is O'Shaughnessy's (1987); a flat spectrum gives a flat result.
    """
    first, last = (2595.0 * math.log10(1.0 + hertz / 700.0) for hertz in (low, high))
    edges = 700.0 * (10.0 ** (np.linspace(first, last, n_mels + 2) / 2595.0) - 1.0)
    bins = np.arange(n_fft // 2 + 1) * (SAMPLE_RATE / n_fft)
    rise = (bins[None] - edges[:-2, None]) / (edges[1:-1] - edges[:-2])[:, None]
    fall = (edges[2:, None] - bins[None]) / (edges[2:] - edges[1:-1])[:, None]
    triangles = np.maximum(np.minimum(rise, fall), 0.0)
    return np.asarray(triangles * (2.0 / (edges[2:] - edges[:-2]))[:, None], np.float32)


def cepstra(speech: npt.NDArray[np.floating], frames: int, frame_rate: float) -> npt.NDArray[np.float64]:
    """Features (frames, 2 · 13) of speech (S,) at 16 kHz: standardised cepstra and their slopes.

    The mean and the variance over the sentence, which depend on voice and microphone more than on sounds, are removed.
    """
    # One window of speech per motion frame, centred on the frame, so that an alignment of features is one of frames.
    hop = SAMPLE_RATE / frame_rate
    padded = np.pad(np.asarray(speech, np.float64), (N_FFT // 2, N_FFT // 2 + int(hop)))
    starts = [round(hop * (frame + 0.5)) for frame in range(frames)]
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(N_FFT) / N_FFT)
    power = np.abs(np.fft.rfft(np.stack([padded[start : start + N_FFT] for start in starts]) * hann)) ** 2
    energy = np.log(power @ mel_filters(N_MELS, N_FFT, 60.0, 7600.0).astype(np.float64).T + 1e-6)
    # The cosine transform of the log energies: its first coefficients describe the shape of the vocal tract, its later
    # ones the pitch, which differs between speakers.
    angle = (np.arange(N_MELS) + 0.5) * np.pi / N_MELS
    features = energy @ np.cos(angle[:, None] * np.arange(N_CEPSTRA))
    slopes = np.gradient(features, axis=0) if frames > 1 else features
    features = np.concatenate([features, slopes], axis=1)
    return np.asarray((features - features.mean(0)) / np.maximum(features.std(0), 1e-6))


def align_features(first: npt.NDArray[np.float64], second: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """For each frame of ``first`` the frame of ``second`` that goes with it, by dynamic time warping.

    Returns:
        indices (T,) into ``second``, never falling; where several frames go with one, the middle one.
    """
    with needs_extra("dtaidistance", "mesh", "aligning two recordings of one sentence"):
        from dtaidistance import dtw_ndim
        from dtaidistance.dtw import best_path
    # The path may leave the diagonal by a quarter of the sentence. Without a band, a pause of one recording could be
    # aligned with half a sentence of the other.
    window = round(BAND * max(len(first), len(second))) + abs(len(first) - len(second)) + 1
    _, costs = dtw_ndim.warping_paths_fast(np.ascontiguousarray(first), np.ascontiguousarray(second), window=window)
    partners: list[list[int]] = [[] for _ in first]
    for row, column in best_path(costs):
        partners[row].append(column)
    return np.array([column[len(column) // 2] for column in partners], np.int64)
