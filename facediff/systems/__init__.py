"""Systems: LightningModules that turn speech into facial motion."""

from facediff.systems.animation import Style
from facediff.systems.base import SpeechAnimator
from facediff.systems.checkpoint import load_system
from facediff.systems.dual_path import DualPathDiffusion
from facediff.systems.style_content import StyleContentDisentanglement

__all__ = ["DualPathDiffusion", "SpeechAnimator", "Style", "StyleContentDisentanglement", "load_system"]
