"""Callbacks: what happens around training and testing."""

from facediff.callbacks.prediction_writer import PredictionWriter
from facediff.callbacks.score_table import ScoreTable
from facediff.callbacks.speech_features import SpeechFeatureCache

__all__ = ["PredictionWriter", "ScoreTable", "SpeechFeatureCache"]
