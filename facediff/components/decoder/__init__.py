"""Decoders: fused features and style tokens to the features of the clean motion."""

from facediff.components.decoder.base import Decoder, DecoderFactory

__all__ = ["Decoder", "DecoderFactory"]
