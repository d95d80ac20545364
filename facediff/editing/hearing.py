"""An animation's speech as models hear it; what is played and written keeps its own sample rate."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.animation import Animation
from facediff.utils import SAMPLE_RATE


def heard(animation: Animation) -> npt.NDArray[np.float32] | None:
    """The speech (S,) at 16 kHz; None for a silent animation."""
    if animation.speech is None or animation.sample_rate == SAMPLE_RATE:
        return animation.speech
    from facediff.speech.audio import to_speech

    return to_speech(animation.speech, animation.sample_rate, animation.name)
