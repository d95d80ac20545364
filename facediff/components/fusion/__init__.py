"""Fusions: where the speech features meet the embedded noisy motion."""

from facediff.components.fusion.base import Fusion, FusionFactory

__all__ = ["Fusion", "FusionFactory"]
