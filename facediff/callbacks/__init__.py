"""Callbacks: what happens around training and testing."""

from facediff.callbacks.prediction_writer import PredictionWriter
from facediff.callbacks.score_table import ScoreTable

__all__ = ["PredictionWriter", "ScoreTable"]
