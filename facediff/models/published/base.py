"""Common parts of the field's published methods: each of them adds its network, its loss and its inference.

They encode speech by a pretrained network at 50 steps a second, count their frames by it, know a speaker as one
column of a table, and train on motion as it is, without a scale, one clip at a time.
"""

from __future__ import annotations

import math
import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from facediff.data import Batch, Reference
from facediff.errors import ArgumentError, OptionError
from facediff.hyperparameters import component_class
from facediff.models.audio_encoders import AudioEncoder, AudioEncoderFactory, StepRule
from facediff.models.base import AnimationModel, Decay
from facediff.models.checkpoint_content import MotionScale
from facediff.models.evaluation import IdentityPolicy
from facediff.models.graphs import (
    BATCH,
    FRAMES,
    Graph,
    Graphs,
    ModelPart,
    SamplingLoop,
    Speech,
    SpeechInput,
    StyleSource,
    results_of,
    speech_graph,
)
from facediff.models.inference import BatchMotion, Progress, Style
from facediff.models.layers import Width, frame_mask
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.speech.windows import FrameClock, Rule
from facediff.utils.hints import fits, options_of

if TYPE_CHECKING:
    from facediff.models.published.cards import AuthorFiles, Facts
    from facediff.models.published.import_options import ImportOptions

LongSpeech = Literal["refuse", "windows", "extend"]
"""The treatment of speech beyond the tables of the published code."""

TRAINED_NETWORK = partial(Wav2Vec2Encoder, spec_augment=True, layer_drop=0.1, edges=False)
"""A pretrained speech network as most of the methods train it: all but its convolutions, with masks and layer drop."""

NO_STYLE = Style("none", torch.zeros(0))
"""The style of a model that takes none."""


class PublishedModel(AnimationModel):
    """Base of the published methods.

    A method adds ``losses`` and :meth:`generate_frames`; it encodes speech by ``audio_encoder``, and takes
    the weights of a clip's speaker from :meth:`identity_weights`.

    Class attributes:
        published_encoder: the audio encoder as the method's authors use it.
        table_frames: frames for which the published tables of attention have rows; None where there are none.
        clock_rule: how frames are counted where speech is resampled to them at every frame rate: of the motion nothing
            is cut then; None to count by the steps of the speech network.
        interpolates: whether speech is interpolated to the frames at 25 frames a second too, where the other methods
            take pairs of steps.

    Args:
        audio_encoder: speech to features; the method's own pretrained network with its settings if None.
        audio_dim: channels of an encoder that does not state them by itself, as a pretrained network does.
        motion_scale: as in :class:`facediff.models.AnimationModel`; the published methods scale nothing.
        weight_decay: AdamW's; the published methods train with Adam, which is AdamW with a decay of 0.
        unseen_identity: as in the same class; the published methods condition an unseen speaker on each training
            identity in turn.
        options: of every model, see :class:`facediff.models.AnimationModel`.
    """

    counts_own_frames: ClassVar[bool] = True
    published_encoder: ClassVar[AudioEncoderFactory]
    table_frames: ClassVar[int | None] = None
    clock_rule: ClassVar[Rule | None] = None
    interpolates: ClassVar[bool] = False
    long_speech: LongSpeech = "extend"

    def __init__(
        self,
        *,
        audio_encoder: AudioEncoderFactory | None = None,
        audio_dim: Width | None = None,
        motion_scale: MotionScale = "none",
        weight_decay: Decay = 0.0,
        unseen_identity: IdentityPolicy = "each_seen",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(
            motion_scale=motion_scale, weight_decay=weight_decay, unseen_identity=unseen_identity, **options
        )
        # Speech at 50 steps a second: pairs of steps for each frame on BIWI, interpolated to the frames on VOCASET.
        self.pairs = self.frame_rate == 25.0 and not self.interpolates
        self.audio_encoder, self.audio_width = make_encoder(audio_encoder or self.published_encoder, audio_dim)

    @property
    def coordinates(self) -> int:
        """Numbers of a frame of motion."""
        return self.n_vertices * self.dims

    def scaled_truth(self, batch: Batch, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames coordinates"]:
        """True motion as training compares it, of so many frames."""
        return (batch.motion * self.scale).flatten(2)[:, : int(frames.max())]

    def offsets_of(self, motion: Float[Tensor, "batch frames coordinates"]) -> BatchMotion:
        """Scaled motion of a network in the unit of the corpus."""
        return motion.view(*motion.shape[:2], self.n_vertices, self.dims) / self.scale

    def keep_hyperparameters(self, arguments: dict[str, Any]) -> None:
        """Save the arguments as every model does, with the published audio encoder where none was given."""
        encoder = arguments.get("audio_encoder")
        super().keep_hyperparameters({**arguments, "audio_encoder": encoder or self.published_encoder})

    @classmethod
    def encoder_settings(cls) -> dict[str, Any]:
        """Options of the published encoder without the source of its weights, for a checkpoint that brings its own."""
        keywords: dict[str, Any] = cls.published_encoder.keywords  # type: ignore[attr-defined]
        return {name: value for name, value in keywords.items() if name != "source"}

    # For a method to implement.

    @classmethod
    def author_facts(cls, files: AuthorFiles, options: ImportOptions) -> Facts | None:  # noqa: ARG003
        """Faces and data of an author's checkpoint; None where the data set and the templates say them."""
        return None

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:  # noqa: ARG003
        """Change an author's tensors as no table of names can; the options of the model that follow."""
        return {}

    @abstractmethod
    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """Offsets from the template, in the corpus's unit.

        Args:
            batch: clips, of which speech and identity are used.
            frames: how many each clip gets, at least 1, as :meth:`frames_of` counts them.
            seeds: of the noise, one for each clip; equal seeds of clips as long as each other give equal noise.
            progress: wraps the iteration over steps.

        Returns:
            motion of ``frames.max()`` frames; beyond a clip's own frames it has no meaning.
        """

    # The audio encoder and the clock of speech.

    def steps_of(self, samples: int) -> int:
        """Steps at 50 a second that a pretrained network gives for so many samples."""
        return self.audio_encoder.steps_of(samples)

    @property
    def clock(self) -> FrameClock:
        """By the steps of the speech network, or the method's own rule."""
        if self.clock_rule is not None:
            return FrameClock(self.frame_rate, self.clock_rule)
        return FrameClock(self.frame_rate, "pairs" if self.pairs else "steps", self.audio_encoder.convolutions())

    def plan_long_speech(self, long_speech: LongSpeech) -> None:
        """Choose the treatment of speech beyond the published tables: by windows only where that is chosen."""
        self.long_speech = long_speech
        by_windows = long_speech == "windows" and self.table_frames is not None
        above = (self.table_frames or 0) / self.frame_rate if by_windows else math.inf
        self.windows = type(self.windows)(above=above)

    def check_length(self, frames: Int[Tensor, " batch"], names: Sequence[str]) -> None:
        """Refuse clips of more frames than the published tables have, with what to do instead."""
        longest, rows = int(frames.max()), self.table_frames
        if rows is not None and longest > rows and self.long_speech != "extend":
            raise OptionError.naming(
                f"{names[int(frames.argmax())]}: {longest / self.frame_rate:.1f} s are {longest} frames, and "
                f"{type(self).__name__}'s published tables have {rows} ({rows / self.frame_rate:g} s); animate it in "
                f"windows ({{window}} 4), or make the model with long_speech=extend or long_speech=windows"
            )

    def tested_frames(self, batch: Batch) -> list[int]:
        """Frames that the method gives for each clip of a corpus."""
        return [self.frames_of(int(samples)) for samples in batch.audio_lengths]

    def trained_frames(self, batch: Batch) -> Int[Tensor, " batch"]:
        """Frames of each clip that training compares: motion that lasts longer than pairs of steps is cut."""
        lengths = batch.frame_lengths
        if not self.pairs or self.clock_rule is not None:
            return lengths
        steps = torch.tensor([self.steps_of(int(n)) // 2 for n in batch.audio_lengths], device=lengths.device)
        return torch.minimum(lengths, steps.clamp_min(1))

    def speech_features(
        self, speech: SpeechInput, steps: Int[Tensor, " batch"], rule: StepRule
    ) -> Float[Tensor, "batch steps width"]:
        """The audio encoder's features at so many steps of each clip."""
        cached = speech.cached_features or ()
        return self.audio_encoder.at_steps(speech.audio, speech.audio_lengths, steps, rule, *cached)

    # The speaker.

    def personal_modules(self) -> list[nn.Module]:
        """The network's table of speakers, where it has one."""
        return [module for name, module in self.named_modules() if name == "network.style"]

    def identity_weights(self, batch: Batch) -> Float[Tensor, "batch identities"]:
        """One-hot rows of the clips' identities; of an unknown speaker :meth:`unknown_weights`.

        A clip that has a style of :meth:`own_styles`, or a mixture of them, has its weights.
        """
        weights = self.weights_of(batch.identity)
        styled = batch.style is not None and batch.style.shape[1] == weights.shape[1]
        return (batch.style if styled else weights).to(batch.template)  # type: ignore[union-attr]

    def weights_of(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch identities"]:
        """One-hot rows of identities; of an unknown speaker (−1) :meth:`unknown_weights`."""
        rows = torch.arange(len(self.identities), device=identity.device)
        one_hot = (identity[:, None] == rows).float()
        return torch.where(identity[:, None] >= 0, one_hot, self.unknown_weights().to(one_hot))

    def unknown_weights(self) -> Float[Tensor, " identities"]:
        """The weights of an unknown speaker."""
        count = len(self.identities)
        return torch.full((count,), 1.0 / count)

    def styled_identities(self) -> list[str]:
        """Every training identity: the table is the style."""
        return list(self.identities)

    def own_styles(self) -> dict[str, Style]:
        """Each training identity as weights that choose its row of the table, so that rows may be mixed."""
        if not self.personal_modules():
            return {}
        rows = torch.eye(len(self.identities))
        return {name: Style(name, row) for name, row in zip(self.identities, rows, strict=True)}

    def default_style(self, identity: str) -> Reference | Style:
        """A style vector of no numbers, since the method takes no reference motion."""
        return NO_STYLE

    # Inference.

    def generate_clips(self, batch: Batch, *, seed: int = 0, progress: Progress | None = None) -> BatchMotion:
        """The method's own number of frames for each clip; the last one is held as long as the clip lasts.

        The published methods give a frame less than the motion has, or two; scores count all frames of the truth.
        """
        frames = torch.tensor([max(1, count) for count in self.tested_frames(batch)], device=batch.audio.device)
        seeds = [zlib.crc32(name.encode()) + seed for name in batch.names]
        motion = self.generate_frames(batch, frames, seeds=seeds, progress=progress)
        return hold_last_frame(motion, frames, batch.frame_lengths)

    def generate_samples(self, clip: Batch, seeds: Sequence[int], *, progress: Progress | None = None) -> BatchMotion:
        """Several samples of one clip; a method without noise makes one."""
        count = len(seeds) if self.samples else 1
        frames = torch.tensor([max(1, self.frames_of(int(clip.audio_lengths[0])))] * count, device=clip.audio.device)
        clips = clip if count == 1 else clip.select([0] * count)
        generated = self.generate_frames(clips, frames, seeds=list(seeds)[:count], progress=progress)
        motion = hold_last_frame(generated, frames, clip.frame_lengths.expand(count))
        return motion if self.samples else motion.expand(len(seeds), -1, -1, -1)


class DirectModel(PublishedModel):
    """Base of the published methods that generate all frames in one pass, without random numbers.

    Class attributes:
        step_rule: how speech is brought to the frames.
    """

    step_rule: ClassVar[StepRule] = "features"
    speech_steps: int = 1
    """Steps that the audio encoder is asked for, for each frame."""

    def encode_speech(self, speech: SpeechInput, frames: Int[Tensor, " batch"]) -> Float[Tensor, "batch frames *width"]:
        """Speech features of each frame."""
        return self.speech_features(speech, frames, self.step_rule)

    @abstractmethod
    def decode(
        self,
        features: Float[Tensor, "batch frames *width"],
        weights: Float[Tensor, "batch identities"],
        frames: Int[Tensor, " batch"] | None,
    ) -> Float[Tensor, "batch frames coordinates"]:
        """Scaled motion."""

    def penalty(self, difference: Float[Tensor, "batch frames coordinates"]) -> Tensor:
        """The error of each number in training: its square."""
        return difference.square()

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """The mean of :meth:`penalty`."""
        frames = self.trained_frames(batch)
        predicted = self.decode(self.encode_speech(batch, frames), self.identity_weights(batch), frames)
        error = masked_mean(self.penalty(predicted - self.scaled_truth(batch, frames)), frames)
        return {"reconstruction": error, "loss": error}

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """All frames in one pass; nothing is random."""
        motion = self.decode(self.encode_speech(batch, frames), self.identity_weights(batch), frames)
        return self.offsets_of(motion)

    def graphs(self) -> Graphs:
        """Speech to features, features to motion."""

        def encode(speech: Speech, frames: Int[Tensor, " batch"], _: int) -> Tensor:
            return self.encode_speech(speech, frames)

        speech = speech_graph(self, encode, lambda frames: self.speech_steps * frames)
        features = results_of(speech)
        inputs: dict[str, Any] = {"features": features, "identity": torch.zeros(len(features), dtype=torch.long)}
        motion = Graph("motion", DirectMotion(self), inputs, {"features": FRAMES, "identity": BATCH}, ("offsets",))
        return whole_model(self, [speech, motion])


# The methods as graphs, without PyTorch; see facediff.models.graphs.


def whole_model(model: PublishedModel, parts: list[Graph], sampling: SamplingLoop | None = None) -> Graphs:
    """A published method's graphs, with the facts that an exported model needs next to them."""
    style: StyleSource = "identity" if model.own_styles() else "none"
    longest = None if model.long_speech == "extend" else model.table_frames
    return Graphs(
        parts=parts,
        equal_lengths=True,
        blending="motion",
        clock=model.clock,
        style=style,
        epsilon=float(getattr(model.audio_encoder, "epsilon", 1e-7)),
        longest=longest or 0,
        sampling=sampling,
    )


class DirectMotion(ModelPart[DirectModel]):
    """Features of speech to offsets from the template."""

    def forward(
        self, features: Float[Tensor, "batch frames *width"], identity: Int[Tensor, " batch"]
    ) -> Float[Tensor, "batch frames points dims"]:
        """In the unit of the corpus; the identity is an index, or −1."""
        model = self.model
        motion = model.decode(features, model.weights_of(identity), None)
        return model.offsets_of(motion)


# Parts of their networks and losses.


class SpeakerTable(nn.Module):
    """One row for each training identity, so that a speaker more is a row more.

    Args:
        count: identities.
        dim: channels of a row.
        like: how it starts: as PyTorch's ``linear`` map of one-hot rows, or as its ``embedding``.
    """

    def __init__(self, count: int, dim: int, like: Literal["linear", "embedding"] = "linear") -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.empty(count, dim))
        if like == "linear":
            # PyTorch's start for a map of ``count`` inputs; normal rows would be some √(3·count) times as large and
            # outweigh speech at first.
            nn.init.uniform_(self.weight, -1 / math.sqrt(count), 1 / math.sqrt(count))
        else:
            nn.init.normal_(self.weight)

    def forward(self, weights: Float[Tensor, "batch identities"]) -> Float[Tensor, "batch dim"]:
        """The rows, mixed by the weights that :meth:`PublishedModel.identity_weights` gives."""
        return weights @ self.weight


def still_map(dim: int, coordinates: int) -> nn.Linear:
    """The last map of a network, which begins at zero: training starts from the face that does not move."""
    last = nn.Linear(dim, coordinates)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return last


def make_encoder(factory: AudioEncoderFactory, dim: int | None) -> tuple[AudioEncoder, int]:
    """An audio encoder and its channels, which it must be told unless it knows them by itself."""
    if dim is None and not fits(options_of(component_class(factory))["dim"].annotation, None):
        raise ArgumentError({"audio_dim": dim}, "the audio encoder's channels; give them, e.g. 64")
    encoder = factory(dim=dim)  # type: ignore[arg-type]
    width: int = getattr(encoder, "width", dim or 0)
    return encoder, width


def hold_last_frame(motion: BatchMotion, frames: Int[Tensor, " batch"], lengths: Int[Tensor, " batch"]) -> BatchMotion:
    """Motion of ``lengths`` frames of each clip: cut, or with its last frame held; zero on padding."""
    longest = int(lengths.max())
    # An index past the last frame becomes the last frame, which holds it.
    indices = torch.arange(longest, device=motion.device)[None].minimum(frames[:, None] - 1)
    rows = torch.arange(len(motion), device=motion.device)[:, None]
    return motion[rows, indices] * frame_mask(lengths, longest)[..., None, None]


def masked_mean(values: Float[Tensor, "batch frames ..."], frames: Int[Tensor, " batch"]) -> Float[Tensor, ""]:
    """The mean over all numbers of the valid frames: of one clip, what PyTorch's own losses give."""
    flat = values.flatten(2)
    mask = frame_mask(frames, flat.shape[1])[..., None]
    return (flat * mask).sum() / (frames.sum() * flat.shape[2]).clamp_min(1)
