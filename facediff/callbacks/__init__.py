"""Callbacks: what happens around training and testing."""

from facediff.callbacks.compiled_training import CompiledTraining
from facediff.callbacks.dashboard import GradientNorm, RunDescription
from facediff.callbacks.prediction_writer import PredictionWriter
from facediff.callbacks.sampling_preview import SamplingPreview
from facediff.callbacks.score_table import ScoreTable
from facediff.callbacks.speech_features import SpeechFeatureCache

__all__ = [
    "CompiledTraining",
    "GradientNorm",
    "PredictionWriter",
    "RunDescription",
    "SamplingPreview",
    "ScoreTable",
    "SpeechFeatureCache",
]
