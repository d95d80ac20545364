"""Helpers that every package may use: files, jobs, pickles."""

SAMPLE_RATE = 16_000
"""Samples per second of speech, wherever it is read, made or encoded."""
