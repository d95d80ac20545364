"""Audio encoders: speech at 16 kHz to one feature vector per motion frame."""

from facediff.components.audio_encoder.base import AudioEncoder, AudioEncoderFactory

__all__ = ["AudioEncoder", "AudioEncoderFactory"]
