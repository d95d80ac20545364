"""Dual-path style diffusion."""

from facediff.systems.dual_path.system import DualPathDiffusion

__all__ = ["DualPathDiffusion"]
