"""Dual-path style diffusion."""

from facediff.models.dual_path.model import DualPathDiffusion

__all__ = ["DualPathDiffusion"]
