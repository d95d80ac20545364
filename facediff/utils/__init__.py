"""Helpers that every package may use: files, jobs, pickles."""

from typing import Final

SAMPLE_RATE: Final = 16_000
"""Samples per second of speech, wherever it is read, made or encoded."""
