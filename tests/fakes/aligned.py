"""Recordings of noise with TextGrids, as `facediff data align` takes and writes them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import soundfile

from facediff.speech.text_grids import write_text_grid


def write_aligned(path: Path, seconds: float, pauses: list[float]) -> None:
    """A recording of syllables of 0.2 s and pauses of 0.3 s at given times, with its TextGrid."""
    path.parent.mkdir(parents=True, exist_ok=True)
    soundfile.write(path, 0.1 * np.random.default_rng(0).standard_normal(round(seconds * 16_000)), 16_000)
    phones, time = [], 0.0
    while time < seconds - 0.05:
        pause = any(abs(time - at) < 0.1 for at in pauses)
        end = min(time + (0.3 if pause else 0.2), seconds)
        phones.append((time, end, "" if pause else ["M", "AA"][len(phones) % 2]))
        time = end
    write_text_grid(path.with_suffix(".TextGrid"), {"words": phones, "phones": phones}, seconds)
