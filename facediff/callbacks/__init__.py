"""Callbacks for training and testing."""

from lightning.pytorch import Callback

from facediff.callbacks.averaging import EmaWithWarmup
from facediff.callbacks.checkpoints import LastCheckpoint
from facediff.callbacks.dashboard import GradientNorm, RunDescription
from facediff.callbacks.outputs import EpochLines, PredictionWriter, ScoreTable
from facediff.callbacks.previews import SamplingPreview
from facediff.callbacks.sounds import SpokenSoundsTerm
from facediff.callbacks.speed import SpeechFeatureCache

__all__ = [
    "EmaWithWarmup",
    "EpochLines",
    "GradientNorm",
    "LastCheckpoint",
    "PredictionWriter",
    "RunDescription",
    "SamplingPreview",
    "ScoreTable",
    "SpeechFeatureCache",
    "SpokenSoundsTerm",
    "defaults",
]


def defaults() -> list[Callback]:
    """The callbacks of every run of the command line, for your own ``Trainer``.

    They keep ``last.ckpt``, print and write the scores of a test and the files of ``predict``, and log the description
    of a run and the norm of the gradient.

    Example:
        >>> Trainer(callbacks=[*facediff.callbacks.defaults(), EmaWithWarmup()])  # doctest: +SKIP
    """
    return [LastCheckpoint(), ScoreTable(), RunDescription(), GradientNorm(), PredictionWriter()]
