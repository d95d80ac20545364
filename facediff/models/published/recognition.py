"""Recognisers of the published methods' checkpoints, and what they work with: tensors, and facts of the data set.

Each method registers a :class:`Recogniser` next to its model, which says what becomes of every tensor: it is used, or
reported as not needed. :mod:`facediff.models.published.importing` reads the files and builds the model.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal

from torch import Tensor

from facediff.errors import FaceDiffError, OptionError
from facediff.models.published.import_options import ImportOptions
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.spaces import VERTICES, Space
from facediff.utils.licences import Commercial, Licence
from facediff.utils.limits import quoted


@dataclass(frozen=True)
class DatasetFacts:
    """What the projects take for granted of a data set.

    Attributes:
        n_vertices: vertices of its faces.
        frame_rate: frames a second that the methods animate.
        identities: training identities in the order of every project's tables.
        unit: unit of length.
    """

    n_vertices: int
    frame_rate: float
    identities: tuple[str, ...]
    unit: str


def dataset_facts() -> dict[str, DatasetFacts]:
    """The data sets of the released checkpoints."""
    from facediff.data.biwi import Biwi
    from facediff.data.vocaset import Vocaset

    return {
        "vocaset": DatasetFacts(5023, 30.0, tuple(Vocaset.identities), "m"),
        "biwi": DatasetFacts(23370, 25.0, tuple(Biwi.identities), Biwi.unit),
        "multiface": DatasetFacts(6172, 30.0, ("2", "3", "6", "7", "9", "10", "11", "12", "13"), "0.122"),
    }


@dataclass(frozen=True)
class FaceFacts:
    """What a method with faces of its own knows of them: whose data set they are, and the space of their motion.

    Attributes:
        corpus: what it was trained on.
        space: of its motion.
        frame_rate: frames a second that it animates.
        identities: training identities in the order of its table.
        n_points: vertices or channels.
        templates: neutral faces (points, dims) by name.
        unit: unit of length of vertices.
        licences: of what it was trained on.
        notes: what the user should know.
        details: what its recogniser needs to convert the tensors.
    """

    corpus: str
    space: Space
    frame_rate: float
    identities: list[str]
    n_points: int
    templates: dict[str, Tensor]
    unit: str = "m"
    licences: tuple[Licence, ...] = ()
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)


class AuthorsWeights:
    """The tensors of some files, of which each must be used or reported.

    Args:
        tensors: by the authors' names.
        source: the files, for messages.
        arguments: the options that each tensor's file says its model was made with, by the tensor's name.

    Attributes:
        renamed: tensors by the names of facediff's model.
        ignored: why tensors are not needed, by the authors' names.
        notes: what the user should know of them.
    """

    def __init__(
        self, tensors: Mapping[str, Tensor], source: str, arguments: Mapping[str, Mapping[str, Any]] | None = None
    ) -> None:
        self.source = source
        self.tensors = dict(tensors)
        self._arguments = arguments or {}
        self.renamed: dict[str, Tensor] = {}
        self.ignored: dict[str, str] = {}
        self.notes: list[str] = []
        self._used: set[str] = set()
        self._origins: dict[str, str] = {}

    def __contains__(self, name: str) -> bool:
        """Whether there is such a tensor."""
        return name in self.tensors

    def names(self, prefix: str) -> list[str]:
        """The names that begin so."""
        return [name for name in self.tensors if name.startswith(prefix)]

    def get(self, name: str) -> Tensor:
        """A tensor, which counts as used.

        Raises:
            FaceDiffError: if it is missing.
        """
        if name not in self.tensors:
            raise FaceDiffError(
                f"{self.source}: lacks the tensor {name}; give the checkpoint of the whole model, as its authors "
                f"distribute it"
            )
        self._used.add(name)
        return self.tensors[name]

    def shape(self, name: str, dims: int = 2) -> tuple[int, ...]:
        """The shape of a tensor.

        Raises:
            FaceDiffError: if it is missing, or has another number of dimensions.
        """
        shape = tuple(self.get(name).shape)
        if len(shape) != dims or not all(shape):
            raise FaceDiffError(f"{self.source}: its tensor {name} has the shape {shape}; expected {dims} dimensions")
        return shape

    def move(self, old: str, new: str) -> None:
        """Use a tensor under another name.

        Raises:
            FaceDiffError: if it is missing, or another one has that name.
        """
        if new in self.renamed:
            raise FaceDiffError(
                f"{self.source}: holds {self._origins[new]} and {old}, which are the same tensor; expected one of them"
            )
        self.renamed[new] = self.get(old)
        self._origins[new] = old

    def authors_name(self, new: str) -> str:
        """What the authors call a tensor; a missing one is called by those next to it, else as the model does.

        >>> import torch
        >>> weights = AuthorsWeights({"vertice_map.weight": torch.ones(1)}, "vocaset.pth")
        >>> weights.move("vertice_map.weight", "network.motion_in.weight")
        >>> weights.authors_name("network.motion_in.bias")
        'vertice_map.bias'
        """
        if new in self._origins:
            return self._origins[new]
        place, _, kind = new.rpartition(".")
        for there, old in self._origins.items():
            owner, _, other = there.rpartition(".")
            if owner == place and old.endswith(other):
                return f"{old.removesuffix(other)}{kind}"
        return new

    def add(self, new: str, value: Tensor) -> None:
        """Use a tensor that follows from a formula, where the files lack it."""
        self.renamed[new] = value
        self._origins[new] = new

    def arguments(self, name: str) -> Mapping[str, Any]:
        """The options that the file of a tensor says its model was made with; empty if it says none."""
        return self._arguments.get(name, {})

    def move_all(self, old: str, new: str, renames: Iterable[tuple[str, str]] = ()) -> None:
        """Use all tensors whose names begin with ``old``, but for ignored ones, under names that begin with ``new``.

        Args:
            old: how the authors' names begin.
            new: what that becomes.
            renames: parts of the rest of a name and what becomes of them, each applied in turn.
        """
        for name in self.names(old):
            if name in self.ignored:
                continue
            rest = name.removeprefix(old)
            for before, after in renames:
                rest = rest.replace(before, after)
            self.move(name, new + rest)

    def ignore(self, prefix: str, why: str) -> None:
        """Leave out all tensors whose names begin so, and report it."""
        self.ignored.update(dict.fromkeys(self.names(prefix), why))

    def left(self) -> list[str]:
        """Tensors that nothing was done with."""
        return [name for name in self.tensors if name not in self._used and name not in self.ignored]

    def backbone(
        self,
        prefix: str,
        *,
        kind: Literal["wav2vec2", "hubert", "wavlm"],
        facts: CheckpointFacts,
        into: str = "audio_encoder",
        **settings: Any,  # noqa: ANN401
    ) -> partial[Any]:
        """Use a complete wav2vec 2.0, HuBERT or WavLM under ``audio_encoder``, and give the encoder that it belongs to.

        Args:
            prefix: how its names begin, with the dot.
            kind: which network it is.
            facts: may hold the network's configuration; else it follows from the shapes.
            into: what the model calls the encoder.
            settings: options of the encoder, such as ``epsilon``.
        """
        config = backbone_config(self, prefix, kind, facts.audio_config)
        self.ignore(f"{prefix}lm_head.", "letters of a speech recogniser")
        old = ("weight_g", "parametrizations.weight.original0"), ("weight_v", "parametrizations.weight.original1")
        self.move_all(prefix, f"{into}.network.", old)
        # Without the vector that SpecAugment puts on masked frames, the network is made without masking.
        if f"{prefix}masked_spec_embed" not in self:
            config.update(mask_time_prob=0.0, mask_feature_prob=0.0)
            settings["spec_augment"] = False
        return partial(Wav2Vec2Encoder, config=config, **settings)


def backbone_config(
    weights: AuthorsWeights, prefix: str, kind: str, stated: Mapping[str, Any] | None
) -> dict[str, Any]:
    """The configuration of a pretrained network from the shapes of its tensors.

    Raises:
        FaceDiffError: if a tensor is missing, a size cannot be known from shapes, or a given one differs from them.
    """
    convolutions = [weights.shape(name, 3) for name in conv_names(weights, prefix)]
    layers = len({name.split(".")[2 + prefix.count(".")] for name in weights.names(f"{prefix}encoder.layers.")})
    hidden, _ = weights.shape(f"{prefix}feature_projection.projection.weight")
    inner, _ = weights.shape(f"{prefix}encoder.layers.0.feed_forward.intermediate_dense.weight")
    position = f"{prefix}encoder.pos_conv_embed.conv."
    old = f"{position}weight_v"
    _, group, taps = weights.shape(old if old in weights else f"{position}parametrizations.weight.original1", 3)
    large = f"{prefix}feature_extractor.conv_layers.1.layer_norm.weight" in weights
    sizes: dict[str, Any] = {
        "hidden_size": hidden,
        "num_hidden_layers": layers,
        "intermediate_size": inner,
        "conv_dim": [shape[0] for shape in convolutions],
        "conv_kernel": [shape[2] for shape in convolutions],
        "num_feat_extract_layers": len(convolutions),
        "conv_bias": f"{prefix}feature_extractor.conv_layers.0.conv.bias" in weights,
        "feat_extract_norm": "layer" if large else "group",
        "num_conv_pos_embeddings": taps,
        "num_conv_pos_embedding_groups": hidden // group,
    }
    config = {name: value for name, value in (stated or {}).items() if isinstance(name, str)}
    for name, value in sizes.items():
        if name in config and config[name] != value and list_of(config[name]) != value:
            raise OptionError.naming(
                f"{{audio_config}}: its {name} is {quoted(config[name])}, and the tensors of {weights.source} say "
                f"{value}; give the config.json of the very network"
            )
    # What the shapes say comes last: a configuration may only add what no shape tells.
    config = {"do_stable_layer_norm": large, "mask_time_prob": 0.05, **config, **sizes, "model_type": kind}
    if "num_attention_heads" not in config:
        if hidden % 64:
            raise OptionError.naming(
                f"{weights.source}: its audio encoder has {hidden} channels, from which the number of its attention "
                f"heads does not follow; give {{audio_config}} config.json with num_attention_heads"
            )
        config["num_attention_heads"] = hidden // 64
    if "conv_stride" not in config and len(convolutions) != 7:
        raise OptionError.naming(
            f"{weights.source}: its audio encoder has {len(convolutions)} convolutions, whose strides do not follow "
            f"from it; give {{audio_config}} config.json with conv_stride"
        )
    if not config["mask_time_prob"] and not config.get("mask_feature_prob"):
        config["mask_time_prob"] = 0.05  # otherwise the network has no place for masked_spec_embed
    return config


def conv_names(weights: AuthorsWeights, prefix: str) -> list[str]:
    """The weights of the convolutions, in their order; at least one is asked for."""
    names: list[str] = []
    pattern = f"{prefix}feature_extractor.conv_layers.{{}}.conv.weight"
    while pattern.format(len(names)) in weights or not names:
        names.append(pattern.format(len(names)))
    return names


def list_of(value: object) -> object:
    """A tuple as a list; anything else as it is."""
    return list(value) if isinstance(value, tuple) else value


@dataclass(frozen=True)
class CheckpointFacts:
    """What is known of a checkpoint before its recogniser converts it.

    Attributes:
        dataset: the data set's name.
        frame_rate: frames a second.
        identities: training identities, in the order of the table's rows.
        n_vertices: vertices V, or channels of the space.
        audio_config: configuration of the audio encoder, where the user gives it.
        model_options: options of the model or its audio encoder that the user gives.
        graph: file of the frozen graph that the method needs as well.
        details: what the method's own faces need, see :class:`FaceFacts`.
    """

    dataset: str
    frame_rate: float
    identities: list[str]
    n_vertices: int
    space: Space = VERTICES
    audio_config: Mapping[str, Any] | None = None
    model_options: Mapping[str, Any] = field(default_factory=dict)
    graph: Path | None = None
    details: Mapping[str, Any] = field(default_factory=dict)

    def sizes(self) -> dict[str, Any]:
        """The options of a model that follow from its data."""
        space = {} if self.space.is_vertices else {"space": self.space}
        return {
            **{"n_vertices": self.n_vertices, "identities": self.identities, "frame_rate": self.frame_rate},
            **space,
        }


@dataclass(frozen=True)
class Recogniser:
    """How a method's checkpoints are known, and what becomes of them.

    Attributes:
        method: the model's registered name.
        marks: tensors that all of its checkpoints have, by the authors' names.
        unless: beginnings of names that none of them has.
        convert: makes the model's options, but for those that every model has, and uses or ignores the tensors.
        vertices: the number of vertices, or channels, by the tensors' shapes.
        count: the number of training identities by the tensors' shapes; 0 where the method knows no identities.
        layout: of its channels, by :func:`facediff.spaces.layouts.layout`; empty where it animates vertices.
        frame_rate: frames a second that its checkpoints animate, where they are not those of the data set; the option
            ``frame_rate`` then says otherwise.
        graph: the option that names the frozen graph that the method needs as well; empty if it needs none.
        faces: the faces of a method whose space and data sets are its own; None for vertices of the known data sets.
        reads: the options of the import that such a method reads, but for those of all methods.
        licence: of the authors' weights.
        commercial: whether that licence allows commercial use.
        licence_source: where it stands.
    """

    method: str
    marks: tuple[str, ...]
    unless: tuple[str, ...]
    convert: Callable[[AuthorsWeights, CheckpointFacts], dict[str, Any]]
    vertices: Callable[[AuthorsWeights], int]
    count: Callable[[AuthorsWeights], int]
    layout: str = ""
    frame_rate: float | None = None
    graph: str = ""
    faces: Callable[[AuthorsWeights, ImportOptions], FaceFacts] | None = None
    reads: tuple[str, ...] = ()
    licence: str = "unknown"
    commercial: Commercial = "unknown"
    licence_source: str = ""

    def knows(self, weights: AuthorsWeights) -> bool:
        """Whether the tensors are those of this method."""
        return all(name in weights for name in self.marks) and not any(map(weights.names, self.unless))


RECOGNISERS: list[Recogniser] = []
"""All that there are; :func:`register` adds one."""


def register(entry: Recogniser) -> Recogniser:
    """Register how a method's checkpoints are known."""
    RECOGNISERS.append(entry)
    return entry
