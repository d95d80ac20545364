"""Style encoders: how the person moves, from a reference motion."""

from facediff.components.style_encoder.base import StyleEncoder, StyleEncoderFactory

__all__ = ["StyleEncoder", "StyleEncoderFactory"]
