"""SelfTalk (Peng et al.: "A Self-Supervised Commutative Training Diagram to Comprehend 3D Talking Faces", 2023).

A Transformer decoder that makes all frames in one pass, and in training a lip reader, which reads the generated lips
and must find what a frozen speech recogniser finds in the speech. From top to bottom: the model, its network, the lip
reader, the authors' checkpoints. docs/methods.md lists the options for choices of the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Assets, Batch
from facediff.errors import OptionError
from facediff.models.audio_encoders import (
    AudioEncoderFactory,
    Lengths,
    StepRule,
    Waves,
    by_length,
    load_typed,
    standardise,
)
from facediff.models.evaluation import IdentityPolicy
from facediff.models.graphs import SpeechInput
from facediff.models.inference import BatchMotion
from facediff.models.layers import (
    Heads,
    Layers,
    Share,
    Weight,
    Width,
    check_heads,
    frame_mask,
    interpolate_ends,
    needed_mask,
)
from facediff.models.published.base import TRAINED_NETWORK, DirectModel, masked_mean, still_map
from facediff.models.published.cards import ENCODER_NAMES, renamed
from facediff.models.squared_errors import squared_errors
from facediff.utils.ranges import Range

if TYPE_CHECKING:
    from transformers import PreTrainedModel

    from facediff.models.published.cards import AuthorFiles, Facts

LipReading = Literal["text", "none"]
"""The lip reader's target in training: a frozen recogniser's ``text``; with ``none`` there is no lip reader."""


@registry.model.register("SelfTalk")
class SelfTalk(DirectModel):
    """SelfTalk: all frames in one pass, trained with a lip reader.

    Args:
        dim: channels of the decoder; 1024 at 25 frames a second (BIWI) and 512 otherwise if None.
        num_layers: its layers.
        num_heads: its attention heads.
        feed_forward_dim: channels between the two maps of its feed-forward layers; twice ``dim`` if None.
        dropout: in the decoder and the lip reader.
        lip_reader: what reads the generated lips in training: as published, a Transformer that learns from the ``text``
            that a frozen recogniser transcribes; or ``none``, which needs no recogniser and leaves its two losses out.
            Inference needs neither.
        lip_vertices: vertices that the lip reader sees, in its map's order, repeats kept; the corpus's lips if None.
        lip_layers: encoder layers of the lip reader, and as many decoder layers.
        lip_feed_forward_dim: channels between the two maps of its feed-forward layers.
        text_source: the recogniser, a wav2vec 2.0 with a CTC head: a name on the Hugging Face hub or a directory. The
            lip reader has its width and its letters.
        text_config: the recogniser's configuration as plain data; if given, its weights are not read from
            ``text_source`` but left for a checkpoint to fill in. Checkpoints use it.
        vertex_weight: factor of the squared error of positions.
        velocity_weight: factor of the squared error of what changes from frame to frame.
        consistency_weight: factor of the squared distance of the lip reader's features from the recogniser's.
        ctc_weight: factor of the CTC loss of the lip reader's letters and the recogniser's transcript.
        unseen_identity: as for every model; the method knows no identities, so it is tested once.
        options: see :class:`~facediff.models.published.base.PublishedModel`, and of every model.
    """

    checkpoint_options = ("text_config",)  # without it, a file could have weights fetched from anywhere
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        TRAINED_NETWORK, source="jonatasgrosman/wav2vec2-large-xlsr-53-english", epsilon=1e-7
    )

    def __init__(
        self,
        *,
        dim: Width | None = None,
        num_layers: Layers = 1,
        num_heads: Heads = 4,
        feed_forward_dim: Width | None = None,
        dropout: Share = 0.1,
        lip_reader: LipReading = "text",
        lip_vertices: Annotated[list[int], Range(0, 2_000_000, items=(1, 1_000_000))] | None = None,
        lip_layers: Layers = 6,
        lip_feed_forward_dim: Width = 2048,
        text_source: str = "jonatasgrosman/wav2vec2-large-xlsr-53-english",
        text_config: dict[str, Any] | None = None,
        vertex_weight: Weight = 1000.0,
        velocity_weight: Weight = 1000.0,
        consistency_weight: Weight = 1e-3,
        ctc_weight: Weight = 1e-4,
        unseen_identity: IdentityPolicy = "style_only",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(unseen_identity=unseen_identity, **options)
        self.windows = type(self.windows)(above=math.inf)  # the decoder has no table of positions
        self.speech_steps = 2 if self.pairs else 1
        dim = dim or (1024 if self.pairs else 512)
        check_heads(dim=dim, num_heads=num_heads)
        self.vertex_weight, self.velocity_weight = vertex_weight, velocity_weight
        self.consistency_weight, self.ctc_weight = consistency_weight, ctc_weight
        self.network = SelfTalkNetwork(
            audio_width=self.audio_width * self.speech_steps,
            coordinates=self.coordinates,
            dim=dim,
            num_layers=num_layers,
            num_heads=num_heads,
            hidden_dim=feed_forward_dim or 2 * dim,
            dropout=dropout,
        )
        self.text: TextNetwork | None = None
        self.reader: LipReader | None = None
        self._reader_options: dict[str, Any] = {
            "num_layers": lip_layers,
            "hidden_dim": lip_feed_forward_dim,
            "dropout": dropout,
        }
        if lip_reader == "text":
            self.text = TextNetwork(text_source, text_config)
            if lip_vertices is not None:
                self.reader = self._make_reader(self.text, lip_vertices)

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the arguments as every model does, with the recogniser's configuration in place of its source."""
        config = {} if self.text is None else self.text.network.config.to_dict()
        super().keep_hyperparameters({**arguments, "text_config": config})

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The lip reader and its recogniser, which only training needs, are left out unless they are asked for."""
        if given_options.get("lip_reader") != "text":
            for prefix in ("text_encoder.", "lip_map.", "transformer.", "lm_head."):
                files.ignore(prefix, "only training needs the lip reader (--option lip_reader=text keeps it)")
            return {"lip_reader": "none"}
        if given_options.get("lip_vertices") is None:
            raise OptionError.naming(
                f"{{option}} lip_reader=text: no file holds the {files.size('lip_map.weight', 1) // 3} vertices that "
                f"the lip reader sees; give them in the authors' order as {{option}} lip_vertices=[0,1,...]"
            )
        for name in files.beginning("text_encoder."):
            files.tensors[renamed(name, (("^text_encoder", "text.network"), *ENCODER_NAMES))] = files.tensors.pop(name)
        config = files.backbone("text.network.wav2vec2.", "wav2vec2", given_options["audio_config"] or {})
        return {
            "lip_layers": files.count("transformer.encoder.layers."),
            "lip_feed_forward_dim": files.size("transformer.encoder.layers.0.linear1.weight", 0),
            "text_config": config | {"vocab_size": files.size("text.network.lm_head.weight", 0)},
        }

    def make_parts(self, assets: Assets) -> None:
        """Make the lip reader for the corpus's lips, if it was given no vertices of its own."""
        if self.text is not None and self.reader is None:
            lips: list[int] = assets.regions["lips"].tolist()
            self.reader = self._make_reader(self.text, lips).to(self.device)
            # Loading and adaptation rebuild the model from its options, and must make the same reader.
            self.hparams["lip_vertices"] = lips

    def _make_reader(self, text: TextNetwork, vertices: Sequence[int]) -> LipReader:
        """A lip reader of these vertices, with the recogniser's width and letters."""
        return LipReader(vertices, self.dims, dim=text.width, letters=text.letters, **self._reader_options)

    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames width"]:
        """Speech features of each frame; where speech comes in pairs, two hidden states side by side."""
        rule: StepRule = "hidden_cut" if self.pairs else "features"
        steps = self.speech_steps
        hidden = self.speech_features(speech, steps * frames, rule)
        return hidden.reshape(hidden.shape[0], hidden.shape[1] // steps, steps * hidden.shape[2])

    # Training.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Squared errors of positions and velocities, and the two losses of the lip reader."""
        frames = self.trained_frames(batch)
        truth = self.scaled_truth(batch, frames)
        motion = self.network(self.encode_speech(batch, frames), frames)
        position, change = squared_errors(motion, truth, frames)
        terms = {
            "reconstruction": position / (frames.sum() * truth.shape[2]),
            "velocity": change / ((frames - 1).clamp_min(0).sum() * truth.shape[2]).clamp_min(1),
        }
        loss = self.vertex_weight * terms["reconstruction"] + self.velocity_weight * terms["velocity"]
        if self.text is not None and self.reader is not None:
            letters = self.text(batch.audio, batch.audio_lengths)
            read = self.reader(motion, frames, letters.steps)
            terms["consistency"] = masked_mean((read.features - letters.features).square(), letters.steps)
            terms["ctc"] = ctc(read.letters, letters.transcripts(), letters.steps, self.text.blank)
            loss = loss + self.consistency_weight * terms["consistency"] + self.ctc_weight * terms["ctc"]
        return {**terms, "loss": loss}

    # Inference.

    def decode(self, features: Tensor, weights: Tensor, frames: Int[Tensor, " batch"] | None) -> Tensor:
        """By the decoder, which knows no speakers."""
        motion: Tensor = self.network(features, frames)
        return motion

    @torch.no_grad()
    def read_lips(
        self, motion: BatchMotion, frames: Int[Tensor, " batch"] | None = None
    ) -> Float[Tensor, "batch steps letters"]:
        """The lip reader's output: one number for each letter of its recogniser, at 50 steps a second.

        A model that was made or imported without its lip reader is refused.
        """
        if self.reader is None:
            raise OptionError.naming(
                "lip_reader: the model has none, since animation needs none; train it with lip_reader=text, or import "
                "the checkpoint with {option} lip_reader=text"
            )
        if frames is None:
            frames = torch.full((len(motion),), motion.shape[1], device=motion.device)
        # In floating point as published: 69 frames at 30 a second are 114 steps, not 115.
        counts = [max(1, int(count / self.frame_rate * 50)) for count in frames.tolist()]
        steps = torch.tensor(counts, device=motion.device)
        letters: Tensor = self.reader((motion * self.scale).flatten(2), frames, steps).letters
        return letters


class SelfTalkNetwork(nn.Module):
    """Features of speech to offsets of the vertices, all frames in one pass.

    Its sizes are options of ``SelfTalk``.
    """

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        dim: int,
        num_layers: int,
        num_heads: int,
        hidden_dim: int,
        dropout: float,
    ) -> None:
        super().__init__()
        self.audio_map = nn.Linear(audio_width, dim)
        layer = nn.TransformerDecoderLayer(dim, num_heads, hidden_dim, dropout, batch_first=True)
        self.decoder = nn.TransformerDecoder(layer, num_layers)
        self.motion_out = still_map(dim, coordinates)

    def forward(
        self, speech: Float[Tensor, "batch frames width"], frames: Int[Tensor, " batch"] | None
    ) -> Float[Tensor, "batch frames coordinates"]:
        """The speech features are both decoded and attended to, without positions or a mask."""
        tokens = self.audio_map(speech)
        padding = None if frames is None else padding_of(frames, tokens.shape[1])
        # The published decoder attends to its own input in both attentions, without positions and without a causal
        # mask: the order of frames reaches it through the features of speech alone.
        features = self.decoder(tokens, tokens, tgt_key_padding_mask=padding, memory_key_padding_mask=padding)
        moved: Tensor = self.motion_out(features)
        return moved


def padding_of(lengths: Int[Tensor, " batch"], longest: int) -> Tensor | None:
    """True on padding, as PyTorch's Transformers take it; None where nothing is padded."""
    valid = needed_mask(frame_mask(lengths, longest))
    return None if valid is None else ~valid


# The lip reader.


class LipFeatures(NamedTuple):
    """The lip reader's output: its features, and a number for each letter, both (batch, steps, …)."""

    features: Tensor
    letters: Tensor


class LipReader(nn.Module):
    """A Transformer that reads lips: from offsets of their vertices to letters, 50 times a second.

    Its sizes are options of ``SelfTalk``.
    """

    HEADS = 8
    columns: Tensor

    def __init__(
        self,
        vertices: Sequence[int],
        dims: int,
        *,
        dim: int,
        letters: int,
        num_layers: int,
        hidden_dim: int,
        dropout: float,
    ) -> None:
        super().__init__()
        indices = dims * torch.tensor(list(vertices))[:, None] + torch.arange(dims)
        self.register_buffer("columns", indices.flatten(), persistent=False)
        self.lip_map = nn.Linear(dims * len(vertices), dim)
        layer = nn.TransformerEncoderLayer(dim, self.HEADS, hidden_dim, dropout, batch_first=True)
        # Nested tensors, PyTorch's default here, warn that they are a prototype.
        encoder = nn.TransformerEncoder(layer, num_layers, nn.LayerNorm(dim), enable_nested_tensor=False)
        self.transformer = nn.Transformer(
            dim, self.HEADS, num_layers, num_layers, hidden_dim, dropout, custom_encoder=encoder, batch_first=True
        )
        self.lm_head = nn.Linear(dim, letters)

    def forward(
        self,
        motion: Float[Tensor, "batch frames coordinates"],
        frames: Int[Tensor, " batch"],
        steps: Int[Tensor, " batch"],
    ) -> LipFeatures:
        """Read offsets of all vertices, each clip in so many steps."""
        # Offsets without the template: a lip reader that saw faces would tell speakers by their lips' shape.
        mapped = self.lip_map(motion[..., self.columns])
        counts = zip(mapped, frames.tolist(), steps.tolist(), strict=True)
        # Clip by clip, as ends are aligned: interpolated together, a short clip's last step would lie in its padding.
        parts = [interpolate_ends(clip[None, :count], length)[0] for clip, count, length in counts]
        x = nn.utils.rnn.pad_sequence(parts, batch_first=True)
        padding = padding_of(steps, x.shape[1])
        features = self.transformer(
            x, x, src_key_padding_mask=padding, tgt_key_padding_mask=padding, memory_key_padding_mask=padding
        )
        return LipFeatures(features, self.lm_head(features))


class Transcription(NamedTuple):
    """A recogniser's output: hidden states (batch, steps, dim), likeliest letters (batch, steps), valid steps."""

    features: Tensor
    letters: Tensor
    steps: Lengths
    blank: int

    def transcripts(self) -> list[Tensor]:
        """Each clip's letters without repeats and then without blanks, as CTC reads them."""
        rows = (row[:count].unique_consecutive() for row, count in zip(self.letters, self.steps.tolist(), strict=True))
        return [letters[letters != self.blank] for letters in rows]


class TextNetwork(nn.Module):
    """A frozen speech recogniser with a CTC head, without dropout also in training."""

    def __init__(self, source: str, config: dict[str, Any] | None) -> None:
        super().__init__()
        self.network: PreTrainedModel = load_typed(
            source, config, "ForCTC", "recogniser with a CTC head", encoder="ctc", option="model.text_source"
        )
        self.network.requires_grad_(False)
        self.network.eval()
        settings = self.network.config
        self.width, self.letters, self.blank = settings.hidden_size, settings.vocab_size, settings.pad_token_id or 0

    def train(self, mode: bool = True) -> TextNetwork:
        """Nothing of it is trained."""
        super().train(mode)
        self.network.eval()
        return self

    @torch.no_grad()
    def forward(self, audio: Waves, audio_lengths: Lengths) -> Transcription:
        """Transcribe speech, each clip by itself."""
        # ε = 1e-7, as transformers has had it since 4.26, which SelfTalk was trained with; FaceFormer's 1e-5 differs by
        # 0.5 % for quiet speech.
        features, steps = by_length(standardise(audio, audio_lengths), audio_lengths, self._hidden)
        letters: Tensor = self.network.lm_head(features).argmax(-1)
        return Transcription(features, letters, steps, self.blank)

    def _hidden(self, wave: Tensor) -> Tensor:
        # At least one step, however short the speech is.
        wave = F.pad(wave, (0, max(0, 400 - wave.shape[1])))
        hidden: Tensor = self.network.base_model(wave).last_hidden_state
        return hidden


def ctc(
    letters: Float[Tensor, "batch steps letters"], transcripts: list[Tensor], steps: Lengths, blank: int
) -> Float[Tensor, ""]:
    """The CTC loss, divided by each transcript's letters; the mean over clips."""
    lengths = torch.tensor([len(row) for row in transcripts], device=steps.device)
    targets = nn.utils.rnn.pad_sequence(transcripts, batch_first=True)
    logits = letters.float().log_softmax(-1).transpose(0, 1)
    return F.ctc_loss(logits, targets, steps, lengths, blank)
