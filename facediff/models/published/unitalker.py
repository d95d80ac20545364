"""UniTalker (Fan, Li, Lin, Xiao, Yang: "UniTalker: Scaling up Audio-Driven 3D Facial Animation", 2024).

One network with a head for each kind of face that its eight data sets have: vertices as principal components, weights
of ARKit's shapes, coefficients of FLAME. Here a model has one head, its corpus's. From top to bottom: the model,
its network, the authors' files. docs/methods.md lists the options for
choices of the published code.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from facediff import registry
from facediff.data import Batch, SpeechMotionDataModule
from facediff.errors import FaceDiffError, OptionError, check_known
from facediff.models.audio_encoders import AudioEncoderFactory, StepRule
from facediff.models.evaluation import IdentityPolicy
from facediff.models.graphs import Graphs
from facediff.models.inference import BatchMotion, Progress, Style, with_speech
from facediff.models.layers import Heads, Share, Width, check_heads, exporting, frame_mask
from facediff.models.published.autoregressive import PeriodicDecoder
from facediff.models.published.base import DirectModel, SpeakerTable, masked_mean, still_map
from facediff.models.published.cards import AuthorFiles, Facts, identities_of
from facediff.models.published.convolutions import ConvolutionStack
from facediff.models.published.import_options import ImportOptions
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.spaces import VERTICES, Space
from facediff.spaces.layouts import find_layout, parametric
from facediff.utils import SAMPLE_RATE
from facediff.utils.arrays import open_array, read_arrays
from facediff.utils.licences import Licence
from facediff.utils.ranges import Range

COMMON = "common"
"""The style of the last row of the table: of no speaker; training also shows it to clips of the training speakers."""

DecoderKind = Literal["conv", "transformer"]

WINDOW, OVERLAP = 25, 5
"""Seconds of a published window, and of its overlap with the next."""

PERIOD = 30
"""Frames after which the Transformer's positions and its attention's bias repeat, at any frame rate."""

COMPONENT_WEIGHT, VALUE_WEIGHT = 0.01, 1e-4
"""Weights of the squared error of principal components, and of a parametric space's values."""

COMMON_SHARE = 0.1
"""Share of the clips that are shown with the common style in training."""


@registry.model.register("UniTalker")
class UniTalker(DirectModel):
    """UniTalker: convolutions or one Transformer layer over the frames of a speech network, and a head.

    Its table of speakers has one row more than there are training identities, ``common``, for unknown speakers.

    Args:
        dim: channels of the decoder.
        style_dim: channels of a speaker's row, of ``conv``; a Transformer's are ``dim``.
        decoder_type: ``conv``, as the released models, or ``transformer``.
        num_heads: attention heads of the Transformer.
        dropout: on the features of speech, and in the Transformer.
        components: principal components of the training motion that the head of a corpus of vertices predicts; 0 for
            the vertices themselves, as of weights.
        frozen_epochs: epochs in the beginning in which the speech network is not trained.
        options: see :class:`~facediff.models.published.base.PublishedModel`, and of every model.
    """

    # WavLM base plus asks for no standardisation of its speech: the published B model hears the waveform as it is.
    step_rule: ClassVar[StepRule] = "hidden"
    clock_rule = "rows"  # as many frames as speech lasts, rounded to even
    published_encoder: ClassVar[AudioEncoderFactory] = partial(
        Wav2Vec2Encoder, source="microsoft/wavlm-base-plus", spec_augment=True, edges=False, do_normalize=False
    )

    def __init__(
        self,
        *,
        dim: Width = 256,
        style_dim: Width = 64,
        decoder_type: DecoderKind = "conv",
        num_heads: Heads = 4,
        dropout: Share = 0.1,
        components: Annotated[int, Range(0, 16_384)] | None = None,
        frozen_epochs: Annotated[int, Range(0, 10**6)] = 1,
        unseen_identity: IdentityPolicy = "style_only",
        **options: Any,  # noqa: ANN401
    ) -> None:
        super().__init__(unseen_identity=unseen_identity, **options)
        if decoder_type == "transformer":
            check_heads(dim=dim, num_heads=num_heads, even=True)
        self.frozen_epochs = frozen_epochs
        self.windows = type(self.windows)(above=math.inf)  # the method has windows of its own
        if components is None:
            components = 512 if self.space.is_vertices else 0
        self.network = UniTalkerNetwork(
            audio_width=self.audio_width,
            coordinates=self.coordinates,
            rows=len(self.identities) + 1,
            dim=dim,
            style_dim=dim if decoder_type == "transformer" else style_dim,
            decoder_type=decoder_type,
            num_heads=num_heads,
            dropout=dropout,
            components=components,
        )

    def measure(self, data: SpeechMotionDataModule, at_least: int = 0) -> Float[Tensor, "components all"] | None:
        """The head's principal components are the training motion's."""
        count = self.network.components
        principal = super().measure(data, max(at_least, count))
        if count:
            mean, shapes = data.principal_motion(count)
            self.network.attach(mean * self.scale, shapes * self.scale)
        return principal

    @classmethod
    def author_facts(cls, files: AuthorFiles, options: ImportOptions) -> Facts:
        """The chosen data set's faces."""
        return faces_of(files, options)

    @classmethod
    def read_author(cls, files: AuthorFiles, facts: Facts, given_options: Mapping[str, Any]) -> dict[str, Any]:
        """The rows of the table and the head of one data set, and its principal components."""
        data, first, count = facts.details["data"], facts.details["first"], len(facts.identities)
        table, head = files[TABLE], f"out_head_dict.{data['head']}."
        files.tensors[TABLE] = torch.cat([table[first : first + count], table[-1:]])
        for name in files.beginning("out_head_dict."):
            if name.startswith(head):
                files.tensors[f"network.head.{name.removeprefix(head)}"] = files.tensors.pop(name)
            else:
                files.ignore(name, f"a head for other faces than those of {facts.dataset}; import it with --dataset")
        components = 0
        if facts.space.is_vertices:
            components = files.size("network.head.weight", 0)
            mean, basis = components_of(facts.details["root"], data, components)
            files.tensors |= {"network.mean": mean, "network.basis": basis}
        kind: DecoderKind = "transformer" if "decoder.PPE.pe" in files.tensors else "conv"
        style = {} if kind == "transformer" else {"style_dim": table.shape[1]}
        # The published B model hears the waveform as it is, the L model the standardised one.
        normalised = not any("rel_attn_embed" in name for name in files.tensors)
        return {"components": components, "decoder_type": kind, "do_normalize": normalised, **style}

    # Speakers: one row more than identities.

    def weights_of(self, identity: Int[Tensor, " batch"]) -> Float[Tensor, "batch rows"]:
        """One-hot rows of identities; of an unknown speaker (−1) the common one."""
        count = len(self.identities)
        return F.one_hot(torch.where(identity >= 0, identity, count), count + 1).float()

    def own_styles(self) -> dict[str, Style]:
        """Each training identity, and the common style."""
        names = [*self.identities, COMMON]
        return {name: Style(name, row) for name, row in zip(names, torch.eye(len(names)), strict=True)}

    def decode(self, features: Tensor, weights: Tensor, frames: Int[Tensor, " batch"] | None) -> Tensor:
        """Offsets from the template."""
        mask = None if frames is None or exporting() else frame_mask(frames, features.shape[1])
        motion: Tensor = self.network.motion(self.network.head(self.network(features, weights, mask)))
        return motion

    # Training and inference.

    def losses(self, batch: Batch, generator: torch.Generator | None = None) -> dict[str, Tensor]:
        """Squared errors: of vertices and their components; of weights also of the vertices that they move."""
        frames = self.trained_frames(batch)
        features = self.encode_speech(batch, frames)
        if self._trainer is not None and self.training and self.trainer.current_epoch < self.frozen_epochs:
            # Gradients of zero, and not none: every process must give every weight one.
            features = features.detach() + 0.0 * (features - features.detach())
        weights = self.identity_weights(batch)
        if self.training:
            common = torch.rand(len(weights), generator=generator, device=weights.device) < COMMON_SHARE
            weights = torch.where(common[:, None], self.weights_of(torch.full_like(batch.identity, -1)), weights)
        mask = frame_mask(frames, features.shape[1])
        coded = self.network.head(self.network(features, weights, mask))
        shape = (*features.shape[:2], self.n_vertices, self.dims)
        truth = (batch.motion * self.scale)[:, : shape[1]]
        difference = self.network.motion(coded).view(shape) - truth
        reconstruction = masked_mean(self.weighed(difference).square(), frames)
        losses = {"reconstruction": reconstruction}
        loss = reconstruction
        if not self.space.is_vertices:
            losses["values"] = masked_mean(difference.square(), frames)
            loss = loss + VALUE_WEIGHT * losses["values"]
        if self.network.components:
            coefficients = self.network.coefficients(truth.flatten(2))
            losses["components"] = masked_mean((coded - coefficients).square(), frames)
            loss = loss + COMPONENT_WEIGHT * losses["components"]
        return {**losses, "loss": loss}

    def generate_frames(
        self, batch: Batch, frames: Int[Tensor, " batch"], *, seeds: Sequence[int], progress: Progress | None = None
    ) -> BatchMotion:
        """In one pass, or of long speech in the published windows."""
        batch = self.standardised(batch)
        if exporting() or int(batch.audio_lengths.max()) <= WINDOW * SAMPLE_RATE:
            return super().generate_frames(batch, frames, seeds=seeds, progress=progress)
        motion = batch.template.new_zeros(len(batch.audio), int(frames.max()), *batch.template.shape[1:])
        for row, count in enumerate(frames.tolist()):
            clip = self.in_windows(batch.select([row]))  # at rates such as 29.97, a frame more or less by rounding
            motion[row, :count] = clip[torch.arange(count).clamp_max(len(clip) - 1)]
        return motion

    def graphs(self) -> Graphs:
        """The published windows of long speech are no part of the graphs."""
        return replace(super().graphs(), longest=round(WINDOW * self.frame_rate))

    def standardised(self, batch: Batch) -> Batch:
        """Speech as the published code hands it on: standardised here, and again by the speech network.

        The second time changes little of a short clip, but a window of long speech then has a level of its own.
        """
        encoder = self.audio_encoder
        if not getattr(encoder, "do_normalize", False) or encoder.has_level or batch.cached_features is not None:
            return batch
        audio = encoder.standardise(batch.audio, batch.audio_lengths, encoder.epsilon)  # type: ignore[arg-type]
        return replace(batch, audio=audio)

    def in_windows(self, clip: Batch) -> Float[Tensor, "frames points dims"]:
        """Motion of one clip: windows of 25 s, faded linearly over overlaps of 5 s."""
        speech = clip.audio[0, : int(clip.audio_lengths[0])]
        window, step = WINDOW * SAMPLE_RATE, (WINDOW - OVERLAP) * SAMPLE_RATE
        count = max(0, math.ceil((len(speech) / SAMPLE_RATE - WINDOW) / (WINDOW - OVERLAP))) + 1
        motion = clip.template.new_zeros(0, *clip.template.shape[1:])
        for number in range(count):
            samples = speech[number * step : number * step + window]
            piece = with_speech(clip, samples, max(1, self.frames_of(len(samples))))
            generated = super().generate_frames(piece, piece.frame_lengths, seeds=[0])[0]
            first = round(number * (WINDOW - OVERLAP) * self.frame_rate)
            before = motion[first : first + len(generated)]
            # Both ends of the overlap are of one window alone, as published.
            share = torch.linspace(0, 1, len(before), dtype=torch.float64, device=speech.device).view(-1, 1, 1)
            mixed = (1 - share) * before + share * generated[: len(before)]
            motion = torch.cat([motion[:first], mixed.to(generated), generated[len(before) :]])
        return motion


class UniTalkerNetwork(nn.Module):
    """Features of speech and a speaker to the coefficients of a head, and these to motion.

    Its sizes are options of ``UniTalker``.
    """

    def __init__(
        self,
        *,
        audio_width: int,
        coordinates: int,
        rows: int,
        dim: int,
        style_dim: int,
        decoder_type: DecoderKind,
        num_heads: int,
        dropout: float,
        components: int,
    ) -> None:
        super().__init__()
        self.style = SpeakerTable(rows, style_dim, like="embedding")
        self.audio_map = nn.Linear(audio_width, dim)
        self.dropout = nn.Dropout(dropout)
        self.convolutions = ConvolutionStack(dim + style_dim, dim) if decoder_type == "conv" else None
        self.transformer = None
        if decoder_type == "transformer":
            self.transformer = PeriodicDecoder(
                dim=dim, num_layers=1, num_heads=num_heads, hidden_dim=2 * dim, dropout=dropout, period=PERIOD, steps=1
            )
        self.components = components
        self.head = still_map(dim, components or coordinates)
        self.register_buffer("mean", torch.zeros(coordinates) if components else None)
        self.register_buffer("basis", torch.zeros(components, coordinates) if components else None)

    mean: Tensor | None
    basis: Tensor | None

    def attach(self, mean: Float[Tensor, " all"], basis: Float[Tensor, "components all"]) -> None:
        """Take over linear shapes; those that training motion has too little of stay zero."""
        assert self.mean is not None  # noqa: S101 - of a head with components
        assert self.basis is not None  # noqa: S101
        count = min(len(basis), len(self.basis))
        self.mean.copy_(mean)
        self.basis[:count].copy_(basis[:count])

    def forward(
        self,
        features: Float[Tensor, "batch frames width"],
        weights: Float[Tensor, "batch rows"],
        mask: Bool[Tensor, "batch frames"] | None = None,
    ) -> Float[Tensor, "batch frames dim"]:
        """Inputs of the heads; frames outside the mask have no meaning."""
        style, memory = self.style(weights), self.audio_map(features)
        if self.transformer is not None:
            # Its queries are the speaker and the frame's position alone; a frame hears its own moment of the speech.
            tokens = style[:, None].expand(-1, memory.shape[1], -1)
            decoded: Tensor = self.transformer(tokens, memory)
            return decoded
        assert self.convolutions is not None  # noqa: S101
        spread = style[:, None].expand(-1, memory.shape[1], -1).to(memory)
        convolved: Tensor = self.convolutions(torch.cat([self.dropout(memory), spread], -1), mask)
        return convolved

    def motion(self, coded: Float[Tensor, "batch frames codes"]) -> Float[Tensor, "batch frames coordinates"]:
        """Offsets of the head's coefficients."""
        return coded if self.basis is None or self.mean is None else coded @ self.basis + self.mean

    def coefficients(
        self, motion: Float[Tensor, "batch frames coordinates"]
    ) -> Float[Tensor, "batch frames components"]:
        """Coefficients of offsets, for shapes that are orthogonal to each other."""
        assert self.mean is not None  # noqa: S101
        assert self.basis is not None  # noqa: S101
        return (motion - self.mean) @ (self.basis / self.basis.square().sum(1, keepdim=True).clamp_min(1e-12)).T


# The authors' files.

TABLE, DEFAULT = "decoder.learnable_style_emb.weight", "D3"
"""The table of speakers of all data sets, and the data set of the faces to animate by default."""


def space_of(name: str) -> Space:
    """The space of a head's numbers; FLAME's 413 with the 300 of the shape, which the released model predicts too."""
    if not name:
        return VERTICES
    layout = find_layout(name)
    if not layout.identity:
        return layout.space
    turns: dict[int, Any] = {rotation.start: (rotation.joint, rotation.form) for rotation in layout.space.rotations}
    inside = {channel for rotation in layout.space.rotations for channel in rotation.channels}
    parts: list[Any] = [f"shape {layout.identity}"]
    for index, channel in enumerate(layout.space.channels):
        if index in turns:
            parts.append(turns[index])
        elif index not in inside:
            parts.append(channel)
    return parametric("flame", parts, version=layout.space.version)


def faces_of(files: AuthorFiles, options: ImportOptions) -> Facts:
    """The chosen data set's frame rate, speakers and neutral face."""
    data_sets, name = files.card.data, options.dataset or DEFAULT
    check_known("{dataset}", "data set of UniTalker", [name], data_sets)
    data, rows = data_sets[name], files.size(TABLE, 0)
    # A checkpoint with another number of rows was trained on one data set alone.
    single = rows != sum(entry["speakers"] for entry in data_sets.values()) + 1
    count = rows - 1 if single else data["speakers"]
    names = identities_of(options.identities, count, [] if single else [f"{name}_{row}" for row in range(count)])
    root, notes = options.data_root, []
    row = data.get("template_row", 0) if options.template_row is None else options.template_row
    faces = np.zeros((row + 1, data["width"]), np.float32)
    if root is not None:
        faces = np.asarray(open_array(Path(root) / data["folder"] / "id_template.npy", kinds="f"))
    elif "layout" not in data or options.template_row is not None:
        raise OptionError.naming(
            f"{{data_root}}: {files.source} holds neither the neutral faces nor the principal components of its "
            f"vertices; give the data release, with {data['folder']}/pca.npz and id_template.npy"
        )
    else:
        notes.append("no --data-root: the published code adds the neutral values of id_template.npy, here they are 0")
    if faces.ndim != 2 or faces.shape[1] != data["width"] or row >= len(faces):
        raise OptionError.naming(f"{{template_row}} {row}: the neutral faces of {name} have the shape {faces.shape}")
    space = space_of(data.get("layout", ""))
    face = torch.from_numpy(faces[row].astype(np.float32) * np.float32(data.get("scale", 1.0))).view(-1, space.dims)
    licence = Licence(f"corpus {data.get('of', f'UniTalker {name}')}")
    if "of" in data:
        licence = Licence(licence.of, "CC-BY-NC-4.0", "forbidden", files.card.licence_source)
    return Facts(
        f"UniTalker {name}",
        data.get("frame_rate", 30.0),
        names,
        dict.fromkeys([COMMON, *names], face),
        space,
        licences=(licence,),
        notes=notes,
        details={
            "data": data,
            "first": 0 if single else sum(entry["speakers"] for key, entry in data_sets.items() if key < name),
            "root": root,
        },
    )


def components_of(root: Path, data: Mapping[str, Any], count: int) -> tuple[Tensor, Tensor]:
    """Mean and principal components of a data set's vertices."""
    path = Path(root) / data["folder"] / "pca.npz"
    names = ("original_data_mean", "components_to_data")
    archive = read_arrays(path, names, remedy="download it again")
    mean, basis = (torch.from_numpy(np.asarray(archive[name], np.float32)) for name in names)
    if mean.shape != (data["width"],) or basis.dim() != 2 or basis.shape[1] != data["width"] or len(basis) < count:
        raise FaceDiffError(
            f"{path}: its mean and components have the shapes {tuple(mean.shape)} and {tuple(basis.shape)}; expected "
            f"{data['width']} numbers each, and {count} components"
        )
    return mean, basis[:count].contiguous()
