"""The networks of style-content disentanglement: motion to content and style, speech to content, both to motion."""

from __future__ import annotations

from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff.components.audio_encoder import AudioEncoder
from facediff.components.mesh_encoder import MeshEncoder
from facediff.components.style_encoder import StyleEncoder
from facediff.systems.style_content.decoder import MotionDecoder
from facediff.systems.style_content.speech import WindowedTransformer

EPSILON = 1e-5


class DisentanglementNetwork(nn.Module):
    """Encoders of content and style, and the one decoder that motion and speech share.

    Args:
        content_encoder: motion to one feature per frame, E_C.
        style_frames: motion to one feature per frame, the first half of E_S.
        style_encoder: these features to one style vector, the second half of E_S.
        audio_encoder: speech to one feature per frame.
        speech_content: features of speech to content.
        decoder: content and style to motion, D.
        standardise_content: take mean and spread over a clip's time out of the content of motion.
    """

    def __init__(
        self,
        *,
        content_encoder: MeshEncoder,
        style_frames: MeshEncoder,
        style_encoder: StyleEncoder,
        audio_encoder: AudioEncoder,
        speech_content: WindowedTransformer,
        decoder: MotionDecoder,
        standardise_content: bool,
    ) -> None:
        super().__init__()
        self.content_encoder = content_encoder
        self.style_frames = style_frames
        self.style_encoder = style_encoder
        self.audio_encoder = audio_encoder
        self.speech_content = speech_content
        self.decoder = decoder
        self.standardise_content = standardise_content

    def content(
        self, motion: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch frames content_dim"]:
        """Content of motion; zero on padding."""
        content = self.content_encoder(motion) * mask[..., None]
        if not self.standardise_content:
            return content
        valid = mask[..., None].to(content.dtype)
        count = valid.sum(1, keepdim=True).clamp_min(1)
        centred = (content - content.sum(1, keepdim=True) / count) * valid
        return centred / (centred.square().sum(1, keepdim=True) / count + EPSILON).sqrt()

    def style(
        self, motion: Float[Tensor, "batch frames vertices 3"], mask: Bool[Tensor, "batch frames"]
    ) -> Float[Tensor, "batch style_dim"]:
        """Style vector of a motion."""
        return self.style_encoder(self.style_frames(motion), mask)

    def hear(
        self,
        audio: Float[Tensor, "batch samples"],
        audio_lengths: Int[Tensor, " batch"],
        frame_lengths: Int[Tensor, " batch"],
        features: tuple[Tensor, Tensor] | None = None,
    ) -> Float[Tensor, "batch frames content_dim"]:
        """Content of speech.

        Args:
            audio: waveforms at 16 kHz.
            audio_lengths: valid samples.
            frame_lengths: motion frames wanted.
            features: cached result of the audio encoder's frozen part, and its lengths.
        """
        return self.speech_content(self.audio_encoder(audio, audio_lengths, frame_lengths, *(features or ())))
