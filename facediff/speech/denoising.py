"""Steady noise taken out of a recording, by the library noisereduce."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import needs_extra
from facediff.speech.audio import fit_length
from facediff.utils import SAMPLE_RATE


def denoised(speech: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
    """Speech (S,) at 16 kHz without its steady noise, by spectral gating; silence stays silence."""
    with needs_extra("noisereduce", "voice", "--denoise"):
        import noisereduce
    if not speech.any():
        return speech
    cleaned = noisereduce.reduce_noise(y=speech, sr=SAMPLE_RATE, stationary=True)
    return fit_length(np.nan_to_num(np.asarray(cleaned, np.float32)), len(speech))
