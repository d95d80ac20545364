"""Callbacks: what happens around training and testing."""

from facediff.callbacks.averaging import EmaWithWarmup
from facediff.callbacks.checkpoints import LastCheckpoint
from facediff.callbacks.dashboard import GradientNorm, RunDescription
from facediff.callbacks.outputs import EpochLines, PredictionWriter, ScoreTable
from facediff.callbacks.previews import SamplingPreview
from facediff.callbacks.speed import CompiledTraining, SpeechFeatureCache

__all__ = [
    "CompiledTraining",
    "EmaWithWarmup",
    "EpochLines",
    "GradientNorm",
    "LastCheckpoint",
    "PredictionWriter",
    "RunDescription",
    "SamplingPreview",
    "ScoreTable",
    "SpeechFeatureCache",
]
