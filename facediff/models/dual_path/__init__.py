"""Dual-path style diffusion."""

from facediff.models.dual_path.many_faces import ManyFaces
from facediff.models.dual_path.model import DualPathDiffusion

__all__ = ["DualPathDiffusion", "ManyFaces"]
