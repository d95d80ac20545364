"""Loudness and melody of a waveform, which brows and head follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from facediff.synthetic.geometry import Array

_HOP, _WINDOW = 0.010, 0.040
_LOWEST_PITCH, _HIGHEST_PITCH = 65.0, 420.0


@dataclass(frozen=True)
class ProsodyContours:
    """Slow contours of a clip, each about -1 to 2 with mean 0 over its voiced part."""

    times: Array  # Middles of the analysis windows, in seconds, shape (n,)
    loudness: Array  # Level relative to the clip's mean, in its standard deviations, shape (n,)
    # Logarithm of the fundamental frequency relative to the clip's mean, in its standard deviations, shape (n,)
    pitch: Array


def analyse(samples: NDArray[np.float32], rate: int) -> ProsodyContours:
    """Contours of a mono waveform (samples,), smoothed over about a syllable; ``rate`` is in samples a second."""
    hop, window = int(_HOP * rate), int(_WINDOW * rate)
    padded = np.pad(np.asarray(samples, dtype=np.float64), window)
    starts = np.arange(0, padded.size - window, hop)
    frames = padded[starts[:, None] + np.arange(window)]
    power = (frames**2).mean(axis=1)
    level = 10.0 * np.log10(power + 1e-7)
    voiced, pitch = _pitch(frames - frames.mean(axis=1, keepdims=True), rate)
    voiced &= level > level.max() - 30.0
    times = (starts - window + 0.5 * window) / rate
    if voiced.sum() < 3:
        return ProsodyContours(times, np.zeros_like(times), np.zeros_like(times))
    melody = np.interp(times, times[voiced], np.log(pitch[voiced]))
    loud = np.maximum(level, level[voiced].mean() - 20.0)
    # The melody fades out where there has been no voice for a while.
    gate = np.clip(1.6 * _blur(voiced.astype(np.float64), 0.12), 0.0, 1.0)
    return ProsodyContours(times, _contour(loud, voiced, 0.08), _contour(melody, voiced, 0.09) * gate)


def _pitch(frames: Array, rate: int) -> tuple[NDArray[np.bool_], Array]:
    """Fundamental frequency by the highest peak of the autocorrelation, and whether there is one."""
    size = 2 * frames.shape[1]
    spectrum = np.abs(np.fft.rfft(frames * np.hanning(frames.shape[1]), size)) ** 2
    correlation = np.fft.irfft(spectrum)[:, : frames.shape[1]]
    low, high = int(rate / _HIGHEST_PITCH), int(rate / _LOWEST_PITCH)
    lag = low + correlation[:, low:high].argmax(axis=1)
    peak = correlation[np.arange(len(lag)), lag]
    return peak > 0.3 * (correlation[:, 0] + 1e-9), rate / lag


def _contour(values: Array, voiced: NDArray[np.bool_], deviation: float) -> Array:
    """Standardise over the voiced part and smooth."""
    mean, spread = values[voiced].mean(), values[voiced].std() + 1e-6
    return _blur(np.clip((values - mean) / spread, -2.5, 2.5), deviation)


def _blur(values: Array, deviation: float) -> Array:
    reach = int(3 * deviation / _HOP)
    return blurred(values, np.arange(-reach, reach + 1) * _HOP / deviation)


def blurred(values: Array, offsets: NDArray[np.floating]) -> Array:
    """Values blurred with a Gaussian that is sampled at ``places``, in standard deviations; the ends are held."""
    kernel = np.exp(-0.5 * offsets**2)
    padded = np.pad(values, len(offsets) // 2, mode="edge")
    return np.convolve(padded, kernel / kernel.sum(), mode="valid")
