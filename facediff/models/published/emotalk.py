"""EmoTalk (Peng et al.: "EmoTalk: Speech-Driven Emotional Disentanglement for 3D Face Animation", 2023).

Two speech networks, one for content and one for emotion: features of both, how strong the emotion is and the speaker
go through a decoder of one layer to the 52 weights of ARKit's face shapes, 30 frames a second. The authors have not
released how they train it, so that it is imported; training goes on with the plain error of the weights. From top to
bottom: the model, its network, the authors' checkpoint. docs/methods.md lists the options for
choices of the published code.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.errors import ArgumentError
from facediff.models.audio_encoders import AudioEncoderFactory, by_length
from facediff.models.graphs import SpeechInput
from facediff.models.layers import Heads, Layers, Share, Width, exporting, interpolate_ends
from facediff.models.published.autoregressive import DecoderLayer
from facediff.models.published.base import DirectModel, SpeakerTable, still_map
from facediff.models.published.positions import periodic_bias
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.speech.windows import STEP_RATE
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts

EMOTION_RATE = 30
"""Steps a second of the emotion network's Transformer, at any frame rate of the motion."""


@registry.model.register("EmoTalk")
class EmoTalk(DirectModel):
    """EmoTalk: content and emotion of speech, from two networks, to weights of face shapes.

    Args:
        dim: channels of the decoder: together of the content, the emotion, its strength and the person.
        emotion_dim: channels of the emotion.
        level_dim: channels of the emotion's strength.
        person_dim: channels of the person.
        num_layers: layers of the decoder.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; ``dim`` if None.
        dropout: in the decoder.
        levels: how many strengths of emotion there are.
        level: the strength that motion is generated with; the authors' demonstration takes 1.
        emotion_source: the network that encodes how it is said, a wav2vec 2.0: a name on the Hugging Face hub or a
            directory.
        emotion_config: its configuration as plain data; if given, its weights are not read from ``emotion_source`` but
            left for a checkpoint to fill in. Checkpoints use it.
        options: see :class:`~facediff.models.published.base.PublishedModel`, and of every model.
    """

    checkpoint_options = ("emotion_config",)  # without it, a file could have weights fetched from anywhere
    clock_rule = "up"  # a frame for every part of one that speech lasts
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder, source="jonatasgrosman/wav2vec2-large-xlsr-53-english", edges=False
    )

    def __init__(
        self,
        *,
        dim: Width = 832,
        emotion_dim: Width = 256,
        level_dim: Width = 32,
        person_dim: Width = 32,
        num_layers: Layers = 1,
        num_heads: Heads = 4,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        levels: Annotated[int, Range(1, 1000)] = 2,
        level: Annotated[int, Range(0, 999)] = 1,
        emotion_source: str = "r-f/wav2vec-english-speech-emotion-recognition",
        emotion_config: dict[str, Any] | None = None,
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(**options)
        if dim % num_heads or dim <= emotion_dim + level_dim + person_dim:
            raise ArgumentError(
                {"dim": dim, "num_heads": num_heads},
                "dim must be a multiple of num_heads, and more than emotion, level and person have together",
            )
        self.level = level
        self.emotion_encoder = Wav2Vec2Encoder(dim=None, source=emotion_source, config=emotion_config, edges=False)
        self.network = EmoTalkNetwork(
            widths=(self.audio_width, self.emotion_encoder.width),
            coordinates=self.coordinates,
            n_identities=len(self.identities),
            levels=levels,
            dim=dim,
            parts=(emotion_dim, level_dim, person_dim),
            num_layers=num_layers,
            num_heads=num_heads,
            hidden_dim=feed_forward_dim or dim,
            dropout=dropout,
            period=max(1, round(self.frame_rate)),
        )

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The emotion network's configuration, and rows of the tables with the bias of the published maps."""
        for name in ("obj_vector_level", "obj_vector_person"):
            files.tensors[f"{name}.weight"] = files[f"{name}.weight"] + files[f"{name}.bias"][:, None]
            del files.tensors[f"{name}.bias"]
        return {"emotion_config": files.speech_network("emotion_encoder", given_options["audio_config"])}

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the arguments as every model does, with the emotion network's configuration in place of its source."""
        config = self.emotion_encoder.network.config.to_dict()
        super().keep_hyperparameters({**arguments, "emotion_config": config})

    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Hidden states of both speech networks side by side, at the frames."""
        return torch.cat([super().encode_speech(speech, frames), self._emotion(speech, frames)], -1)

    def _emotion(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Hidden states of the emotion network, which is resampled twice."""
        encoder = self.emotion_encoder
        features, steps = encoder.frozen_features(speech.audio, speech.audio_lengths)

        def encode(x: Tensor, count: int) -> Tensor:
            # The published class is never told how many frames there are, and counts 30 a second of its own steps
            # before its Transformer; its hidden states are then resampled to the frames. In floating point as there:
            # 205 steps are 122, not 123.
            n_frames = x.shape[1] * EMOTION_RATE // int(STEP_RATE)
            if not exporting():
                n_frames = int(x.shape[1] / STEP_RATE * EMOTION_RATE)
            return interpolate_ends(encoder.hidden_states(interpolate_ends(x, max(1, n_frames))), count)

        return by_length(features, steps, encode, frames)[0]

    def decode(self, features: Tensor, weights: Tensor, frames: Int[Tensor, " batch"] | None) -> Tensor:
        """Every frame sees those before it, and its own moment of the emotion; later frames and padding change none."""
        motion: Tensor = self.network(features, weights, self.level)
        return motion


class EmoTalkNetwork(nn.Module):
    """Features of two speech networks, the level and the person to values of channels.

    Its sizes are options of ``EmoTalk``.
    """

    def __init__(
        self,
        *,
        widths: tuple[int, int],
        coordinates: int,
        n_identities: int,
        levels: int,
        dim: int,
        parts: tuple[int, int, int],
        num_layers: int,
        num_heads: int,
        hidden_dim: int,
        dropout: float,
        period: int,
    ) -> None:
        super().__init__()
        self.widths, self.num_heads, self.period = widths, num_heads, period
        emotion_dim, level_dim, person_dim = parts
        self.content_map = nn.Linear(widths[0], dim - sum(parts))
        self.memory_map = nn.Linear(widths[1], dim)
        self.emotion_map = nn.Linear(dim, emotion_dim)
        self.level = SpeakerTable(levels, level_dim)
        self.style = SpeakerTable(n_identities, person_dim)
        self.layers = nn.ModuleList(DecoderLayer(dim, num_heads, hidden_dim, dropout) for _ in range(num_layers))
        self.motion_out = still_map(dim, coordinates)

    def forward(
        self,
        features: Float[Tensor, "batch frames width"],
        weights: Float[Tensor, "batch identities"],
        level: int,
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Values of the channels, which nothing bounds."""
        content, emotion = torch.split(features, list(self.widths), -1)
        frames = features.shape[1]
        memory = self.memory_map(emotion)
        level_vector = self.level.weight[level].expand(*features.shape[:2], -1)
        person = self.style(weights)[:, None].expand(-1, frames, -1)
        parts = [self.content_map(content), torch.relu(self.emotion_map(memory)), level_vector, person]
        x = torch.cat([part.to(memory) for part in parts], -1)
        bias = periodic_bias(frames, self.num_heads, self.period, device=x.device)
        for layer in self.layers:
            # A frame attends to its own moment of the emotion only.
            moments = layer.cross_attention.keys_values(memory)  # type: ignore[union-attr, operator]
            x = layer(x, moments, layer.self_attention.keys_values(x), bias)  # type: ignore[union-attr, operator]
        motion: Tensor = self.motion_out(x)
        return motion
