"""LAM-Audio2Expression (aigc3d, 2025): speech to the 52 weights of ARKit's face shapes, 30 frames a second.

The output of wav2vec 2.0's convolutions is resampled to the frames, then convolutions over frames that know the
speaker, six Transformer layers in the larger variant, and a sigmoid. From top to bottom: the model, its network, the
authors' checkpoint. docs/methods.md lists the options for choices of the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.models.audio_encoders import AudioEncoderFactory
from facediff.models.layers import Heads, Share, Width, check_heads, exporting, frame_mask
from facediff.models.published.base import DirectModel, SpeakerTable
from facediff.models.published.convolutions import ConvolutionStack
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.spaces import Space
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts


@registry.model.register("LamAudio2Expression")
class LamAudio2Expression(DirectModel):
    """LAM-Audio2Expression: convolutions over the frames of wav2vec 2.0, for weights of face shapes.

    Channels of a valid range pass through a sigmoid, as published; rotations and vertices do not.

    Args:
        dim: channels of the decoder.
        identity_dim: channels of the speaker's row.
        transformer_layers: layers of the Transformer between the convolutions: 6 in the larger published variant, 0 in
            the one for streams.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; twice ``dim`` if None.
        dropout: on the features of speech and in the Transformer.
        options: see :class:`~facediff.models.published.base.PublishedModel`, and of every model.
    """

    clock_rule = "up"  # a frame for every part of one that speech lasts
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder,
        source="facebook/wav2vec2-base-960h",
        edges=False,
        do_normalize=False,  # the network takes the waveform as it is
    )

    def __init__(
        self,
        *,
        dim: Width = 512,
        identity_dim: Width = 64,
        transformer_layers: Annotated[int, Range(0, 256)] = 0,
        num_heads: Heads = 8,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        if transformer_layers:
            check_heads(dim=dim, num_heads=num_heads)
        self.network = LamNetwork(
            audio_width=self.audio_width,
            space=self.space,
            coordinates=self.coordinates,
            n_identities=len(self.identities),
            dim=dim,
            identity_dim=identity_dim,
            layers=transformer_layers,
            num_heads=num_heads,
            hidden_dim=feed_forward_dim or 2 * dim,
            dropout=dropout,
        )

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The map of one-hot speakers is a convolution over one frame."""
        name = "identity_encoder.id_mlp.weight"
        files.tensors[name] = files[name].flatten(1)
        return {}

    def penalty(self, difference: Float[Tensor, "batch frames coordinates"]) -> Tensor:
        """The absolute error."""
        return difference.abs()

    def decode(self, features: Tensor, weights: Tensor, frames: Int[Tensor, " batch"] | None) -> Tensor:
        """Every frame sees its neighbours, and of the larger variant all others."""
        mask = None if frames is None or exporting() else frame_mask(frames, features.shape[1])
        values: Tensor = self.network(features, weights, mask)
        return values * self.scale


class LamNetwork(nn.Module):
    """Features of speech and a speaker to values of channels.

    Its sizes are options of ``LamAudio2Expression``.
    """

    def __init__(
        self,
        *,
        audio_width: int,
        space: Space,
        coordinates: int,
        n_identities: int,
        dim: int,
        identity_dim: int,
        layers: int,
        num_heads: int,
        hidden_dim: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.audio_map = nn.Linear(audio_width, dim)
        self.style = SpeakerTable(n_identities, identity_dim)
        self.style_bias = nn.Parameter(torch.empty(identity_dim).uniform_(-1, 1) / math.sqrt(n_identities))
        self.dropout = nn.Dropout(dropout)
        self.encoder = ConvolutionStack(dim + identity_dim, dim)
        self.transformer = nn.ModuleList(
            nn.TransformerEncoderLayer(dim, num_heads, hidden_dim, dropout, batch_first=True) for _ in range(layers)
        )
        self.decoder = ConvolutionStack(dim, dim, residual=False)
        self.motion_out = nn.Linear(dim, coordinates)
        self.low, self.high = space.valid_range or (0.0, 1.0)
        bounded = torch.zeros(coordinates, dtype=torch.bool)
        if space.valid_range is not None:
            bounded[list(space.face)] = True
        self.register_buffer("bounded", bounded, persistent=False)

    bounded: Bool[Tensor, " coordinates"]

    def encode(
        self,
        features: Float[Tensor, "batch frames width"],
        weights: Float[Tensor, "batch identities"],
        mask: Bool[Tensor, "batch frames"] | None,
    ) -> Float[Tensor, "batch frames dim"]:
        """Speech that knows its speaker."""
        # The authors' map of a one-hot speaker has a bias: it is added to mixtures of speakers as well.
        style = (self.style(weights) + self.style_bias)[:, None].expand(-1, features.shape[1], -1)
        x = self.encoder(torch.cat([self.dropout(self.audio_map(features)), style.to(features)], -1), mask)
        for layer in self.transformer:
            x = layer(x, src_key_padding_mask=None if mask is None else ~mask)
        return x

    def forward(
        self,
        features: Float[Tensor, "batch frames width"],
        weights: Float[Tensor, "batch identities"],
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Values of the channels; frames outside the mask have no meaning."""
        values = self.motion_out(self.decoder(self.encode(features, weights, mask), mask))
        bounded = self.low + (self.high - self.low) * torch.sigmoid(values)
        return torch.where(self.bounded, bounded, values)
