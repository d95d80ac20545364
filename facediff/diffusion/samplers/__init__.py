"""Samplers: how the reverse process is run, chosen by name."""

from facediff.diffusion.samplers.base import Sampler, SamplerFactory

__all__ = ["Sampler", "SamplerFactory"]
