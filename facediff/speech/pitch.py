"""Pitch and speed of speech, changed by a phase vocoder."""

from __future__ import annotations

from typing import cast

import numpy as np
import numpy.typing as npt

from facediff.speech.audio import fit_length
from facediff.utils import SAMPLE_RATE

Wave = npt.NDArray[np.float32]
"""Speech (S,) at 16 kHz."""

SIZE, HOP = 512, 128
"""Samples of a spectrum, and from one to the next: 32 ms and 8 ms, in which a voice hardly changes."""


def spectra(speech: npt.NDArray[np.floating], hop: int = HOP) -> npt.NDArray[np.complexfloating]:
    """Short-time spectra (frames, SIZE/2 + 1), Hann window, the first centred on the first sample."""
    padded = np.pad(np.asarray(speech, np.float32), (SIZE // 2, SIZE // 2 + hop))
    frames = np.lib.stride_tricks.sliding_window_view(padded, SIZE)[::hop]
    return cast(npt.NDArray[np.complexfloating], np.fft.rfft(frames * _WINDOW, axis=1))


def signal(spectrum: npt.NDArray[np.complexfloating], length: int) -> npt.NDArray[np.floating]:
    """Speech (length,) of short-time spectra HOP apart, by overlap and add of windowed frames."""
    frames = np.fft.irfft(spectrum, SIZE, axis=1) * _WINDOW
    count, parts = len(frames), SIZE // HOP
    # Frames SIZE / HOP = 4 apart do not overlap: each residue class is one contiguous row, so that four additions of
    # whole rows replace one per frame.
    out = np.zeros((count + parts) * HOP, np.float32)
    for part in range(parts):
        some = frames[part::parts].reshape(-1)
        out[part * HOP : part * HOP + len(some)] += some
    out = out[SIZE // 2 : SIZE // 2 + length] / 1.5  # the sum of squared Hann windows a quarter apart
    return out if len(out) == length else np.pad(out, (0, length - len(out)))


_WINDOW = np.hanning(SIZE + 1)[:-1].astype(np.float32)


def stretched(speech: Wave, ratio: float) -> npt.NDArray[np.floating]:
    """Speech that lasts ``ratio`` times as long and has the same pitch: a phase vocoder (Flanagan and Golden 1966)."""
    spectrum = spectra(speech)
    length = round(len(speech) * ratio)
    places = np.arange(int(np.ceil(length / HOP)) + 1) / ratio
    low = np.clip(np.floor(places).astype(int), 0, len(spectrum) - 2)
    share = np.clip(places - low, 0, 1)[:, None].astype(np.float32)
    size, angle = np.abs(spectrum), np.angle(spectrum)
    sizes = (1 - share) * size[low] + share * size[low + 1]
    # Flanagan and Golden's phase vocoder: each bin's phase advances by its instantaneous frequency, which is the bin's
    # centre frequency plus the deviation measured between neighbouring spectra, wrapped to (-pi, pi].
    advance = (2 * np.pi * HOP / SIZE * np.arange(SIZE // 2 + 1)).astype(np.float32)
    turn = np.diff(angle, axis=0) - advance
    turn += advance - 2 * np.pi * np.round(turn / (2 * np.pi))
    phase = np.cumsum(np.concatenate([angle[:1], turn[low[:-1]]]), axis=0, dtype=np.float64) % (2 * np.pi)
    phase = phase.astype(np.float32)
    turned = np.empty(phase.shape, np.complex64)
    np.multiply(sizes, np.cos(phase), out=turned.real)
    np.multiply(sizes, np.sin(phase), out=turned.imag)
    return signal(turned, length)


def shifted(speech: Wave, ratio: float) -> Wave:
    """Speech (S,) of the same length with every frequency times ``ratio``."""
    import soxr

    longer = stretched(speech, ratio)
    resampled: Wave = soxr.resample(longer.astype(np.float32), 1000 * ratio, 1000, quality="LQ")
    return fit_length(resampled, len(speech))


def shifted_by_pieces(speech: Wave, ratio: float, seconds: float = 60.0) -> Wave:
    """What :func:`shifted` does, in pieces that fade into one another, so that memory does not grow with the speech."""
    piece, fade = round(seconds * SAMPLE_RATE), SAMPLE_RATE // 20
    out = np.zeros(len(speech), np.float32)
    for start in range(0, len(speech), piece):
        first = max(0, start - fade)
        part = shifted(np.asarray(speech[first : start + piece], np.float32), ratio)
        rising = np.linspace(0, 1, start - first, dtype=np.float32)
        out[first:start] = (1 - rising) * out[first:start] + rising * part[: start - first]
        out[start : start + piece] = part[start - first :]
    return out
