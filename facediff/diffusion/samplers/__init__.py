"""Samplers: how the reverse process is run, chosen by name."""

from facediff.diffusion.samplers.base import NoiseSource, Sampler, SamplerFactory

__all__ = ["NoiseSource", "Sampler", "SamplerFactory"]
