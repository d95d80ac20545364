"""Identity encoders: who the face is, from a label."""

from facediff.components.identity_encoder.base import IdentityEncoder, IdentityEncoderFactory

__all__ = ["IdentityEncoder", "IdentityEncoderFactory"]
