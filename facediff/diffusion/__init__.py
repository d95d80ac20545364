"""The noise process and the samplers that reverse it; knows neither networks nor data."""

from facediff.diffusion.process import NoiseProcess

__all__ = ["NoiseProcess"]
