"""Systems: LightningModules that turn speech into facial motion."""

from facediff.systems.base import SpeechAnimator
from facediff.systems.checkpoint import load_system
from facediff.systems.dual_path import DualPathDiffusion

__all__ = ["DualPathDiffusion", "SpeechAnimator", "load_system"]
