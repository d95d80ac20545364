"""Pitch and speed of speech, changed by overlapping grains of the waveform, and its short-time spectra."""

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
GRAIN, STEP, REACH = 480, 240, 160
"""Samples of a grain, from one to the next, and within which the next one is looked for: 30, 15 and 10 ms."""
_WINDOW, _FADE = (np.hanning(size + 1)[:-1].astype(np.float32) for size in (SIZE, GRAIN))
_DISTANCE = 1e-6 * np.abs(np.arange(-REACH, REACH + 1))  # of equally good grains, as in silence, the nearest


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


def stretched(speech: Wave, ratio: float) -> Wave:
    """Speech that lasts ``ratio`` times as long and has the same pitch, by grains of it that fade into one another.

    Each grain continues the one before as well as any within 10 ms of its place does (WSOLA: Verhelst and Roelands,
    "An overlap-add technique based on waveform similarity", ICASSP 1993). Onsets stay as sharp as they were, which a
    phase vocoder blurs.
    """
    length = round(len(speech) * ratio)
    count = -(-length // STEP) + 1
    middles = np.round(np.arange(count) * (STEP / ratio)).astype(int) + REACH
    before = GRAIN // 2 + REACH
    behind = middles[-1] + REACH + STEP + GRAIN - before - len(speech)
    padded = np.pad(np.asarray(speech, np.float32), (before, behind))
    # The norms of all grains, so that the likest is not merely the loudest: a ratio of 1 leaves speech unchanged.
    sums = np.concatenate([[0.0], np.cumsum(np.square(padded, dtype=np.float64))])
    norms = np.sqrt(np.maximum(sums[GRAIN:] - sums[:-GRAIN], 0)) + 1e-6
    out = np.zeros((count + 1) * STEP, np.float32)
    position = REACH
    for number, middle in enumerate(middles):
        if number:
            following = padded[position + STEP : position + STEP + GRAIN]
            first = middle - REACH
            alike = np.correlate(padded[first : middle + REACH + GRAIN], following, "valid")
            position = first + int(np.argmax(alike / norms[first : middle + REACH + 1] - _DISTANCE))
        out[number * STEP : number * STEP + GRAIN] += _FADE * padded[position : position + GRAIN]
    return out[GRAIN // 2 : GRAIN // 2 + length]


def shifted(speech: Wave, ratio: float) -> Wave:
    """Speech (S,) of the same length with every frequency times ``ratio``."""
    import soxr

    resampled: Wave = soxr.resample(stretched(speech, ratio), 1000 * ratio, 1000, quality="LQ")
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
