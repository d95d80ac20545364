"""Release cards: facts about the checkpoints that the published methods' authors distribute.

A card (``releases/*.yaml``) says by which tensors a checkpoint is recognised, what its tensors are called here, which
sizes can be read from them, and its licence. Conversions beyond a table are code of the method, in
:meth:`PublishedModel.read_author`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor

from facediff.errors import OptionError
from facediff.models.published.positions import periodic_positions
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.spaces import VERTICES, Space
from facediff.utils.hints import is_name
from facediff.utils.licences import Commercial, Licence

Renames = tuple[tuple[str, str], ...]
"""Regular expressions with their replacements, each applied in turn."""

LAYER_NAMES: Renames = (
    (r"self_attn\.in_proj_", "self_attention.project."),
    (r"self_attn\.out_proj", "self_attention.out"),
    (r"multihead_attn\.in_proj_", "cross_attention.project."),
    (r"multihead_attn\.out_proj", "cross_attention.out"),
    (r"linear1", "first"),
    (r"linear2", "second"),
    (r"norm1", "norms.0"),
    (r"norm2", "norms.1"),
    (r"norm3", "norms.2"),
)
"""From the tensors' names in PyTorch's decoder layer to those in ``autoregressive.DecoderLayer``."""

ENCODER_NAMES: Renames = (
    ("weight_g$", "parametrizations.weight.original0"),
    ("weight_v$", "parametrizations.weight.original1"),
)
"""Old and new names of PyTorch's weight norm."""

BACKBONE: dict[str, tuple[str, int]] = {
    "hidden_size": ("feature_projection.projection.weight", 0),
    "intermediate_size": ("encoder.layers.0.feed_forward.intermediate_dense.weight", 0),
    "num_conv_pos_embeddings": ("encoder.pos_conv_embed.conv.parametrizations.weight.original1", 2),
}
"""Sizes of a wav2vec 2.0, HuBERT or WavLM, and the tensor and axis that have them."""


@dataclass(frozen=True)
class Card:
    """Facts about a method's checkpoints.

    Attributes:
        method: the model's registered name.
        required: tensors that all of its checkpoints have, by the authors' names.
        forbidden: beginnings of names that none of them has.
        prefixes: beginnings that all names may have, and that are left out.
        coordinates: tensor and axis with a frame's numbers of motion.
        speakers: tensor and axis with the number of training identities; empty where the method knows none.
        encoders: by the model's name of a speech network: how its tensors' names begin (``prefix``; empty for a search)
            and its ``kind``.
        options: of the model: a value, tensor and axis with a size, or the beginning of names that count layers.
        renames: from the authors' names to the model's.
        layers: beginning of the model's names that are renamed by :data:`LAYER_NAMES`.
        transposed: tensors that the model has transposed, by its names.
        positions: table of positions, computed by its formula here, which tells the frame rate.
        period: of that table; the rounded frame rate if 0.
        ignored: beginnings of names that are not needed, and why.
        layout: of the channels, by :func:`facediff.spaces.layouts.layout`; empty where vertices are animated.
        frame_rate: frames a second, where they differ from the data set's; the option ``frame_rate`` changes it.
        reads: the options of the import that the method reads, beside the options of all methods.
        releases: the released files with their data set and options.
        like: another card with the same renames and ignored names.
        licence: of the weights.
        commercial: whether that licence allows commercial use.
        licence_source: where it stands.
        data: the method's own data sets.
    """

    method: str
    required: tuple[str, ...]
    forbidden: tuple[str, ...] = ()
    prefixes: tuple[str, ...] = ()
    coordinates: tuple[str, int] = ("", 0)
    speakers: tuple[str, int] | tuple[()] = ()
    encoders: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    options: Mapping[str, Any] = field(default_factory=dict)
    renames: Renames = ()
    layers: str = ""
    transposed: tuple[str, ...] = ()
    positions: str = ""
    period: int = 0
    ignored: Mapping[str, str] = field(default_factory=dict)
    layout: str = ""
    frame_rate: float = 0.0
    reads: tuple[str, ...] = ("dataset", "identities", "templates", "regions", "mesh")
    releases: tuple[Mapping[str, Any], ...] = ()
    like: str = ""
    licence: str = "unknown"
    commercial: Commercial = "unknown"
    licence_source: str = ""
    data: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @classmethod
    def read(cls, path: Path) -> Card:
        """The card of a file."""
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
        if "like" in content:
            base_card = yaml.safe_load(path.with_name(f"{content['like']}.yaml").read_text(encoding="utf-8"))
            content |= {name: base_card[name] for name in ("renames", "ignored", "layers")}
        fields: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value for name, value in content.items()
        }
        return cls(**fields)

    def fits(self, names: Mapping[str, Tensor]) -> bool:
        """Whether tensors are of this method."""
        return all(name in names for name in self.required) and not any(
            name.startswith(self.forbidden) for name in names if self.forbidden
        )


@cache
def cards() -> tuple[Card, ...]:
    """All release cards."""
    return tuple(Card.read(path) for path in sorted((Path(__file__).parent / "releases").glob("*.yaml")))


@dataclass
class AuthorFiles:
    """The tensors of a checkpoint on their way to a model.

    Attributes:
        tensors: by the authors' names.
        source: the files, for messages.
        card: of the method.
        arguments: the options that each tensor's file says its model was made with, by the tensor's name.
        ignored: why tensors are not needed, by the authors' names.
    """

    tensors: dict[str, Tensor]
    source: str
    card: Card
    arguments: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    ignored: dict[str, str] = field(default_factory=dict)

    def __getitem__(self, name: str) -> Tensor:
        """A tensor."""
        return self.tensors[name]

    def size(self, name: str, axis: int) -> int:
        """A size of a tensor."""
        return self[name].shape[axis]

    def beginning(self, prefix: str | tuple[str, ...]) -> list[str]:
        """The names that begin so."""
        return [name for name in self.tensors if name.startswith(prefix)]

    def count(self, prefix: str) -> int:
        """How many layers there are below such names."""
        return len({name.removeprefix(prefix).split(".")[0] for name in self.beginning(prefix)})

    def ignore(self, prefix: str, why: str) -> None:
        """Leave out all tensors with this prefix, and report it."""
        for name in self.beginning(prefix):
            self.ignored[name] = why
            del self.tensors[name]

    def sizes(self) -> dict[str, Any]:
        """The card's options of the model: values, and sizes of the tensors that are there."""
        options: dict[str, Any] = {}
        for option, row in self.card.options.items():
            if not isinstance(row, list):
                options[option] = row
            elif len(row) == 1:
                options[option] = self.count(row[0])
            elif row[0] in self.tensors:
                options[option] = self.size(row[0], row[1])
        return options

    def check_positions(self, frame_rate: float, dataset: str) -> None:
        """Leave out the table of positions, once it agrees with the frame rate."""
        name = self.card.positions
        if name not in self.tensors:
            return
        table, period = self.tensors[name].flatten(0, -2), self.card.period or round(frame_rate)
        expected = periodic_positions(len(table), table.shape[-1], period)
        if table.shape != expected.shape or not torch.allclose(table.float(), expected, rtol=0, atol=1e-5):
            raise OptionError.naming(
                f"{{dataset}} {dataset}: the table of positions {name} of {self.source} does not repeat every {period} "
                f"frames; give the data set that it was trained on"
            )
        self.ignore(name, "the table of positions is computed by its formula")

    def speech_network(self, into: str, stated: Mapping[str, Any] | None) -> dict[str, Any]:
        """Move the tensors of a complete wav2vec 2.0, HuBERT or WavLM under ``into``; its configuration.

        Args:
            into: the model's name of the network.
            stated: the network's configuration, where the user gives it, or configurations of several networks by
                name; sizes follow from the tensors all the same.
        """
        entry = self.card.encoders.get(into) or {"prefix": f"{into}.", "kind": "wav2vec2"}
        prefix, first = entry["prefix"], "feature_extractor.conv_layers.0.conv.weight"
        if not prefix:
            prefix = next((name.removesuffix(first) for name in self.tensors if name.endswith(first)), "")
        self.ignore(f"{prefix}lm_head.", "letters of a speech recogniser")
        for name in self.beginning(prefix):
            self.tensors[f"{into}.network.{renamed(name.removeprefix(prefix), ENCODER_NAMES)}"] = self.tensors.pop(name)
        stated = stated or {}
        return self.backbone(f"{into}.network.", entry["kind"], stated.get(into, stated))

    def backbone(self, prefix: str, kind: str, stated: Mapping[str, Any]) -> dict[str, Any]:
        """The configuration of a speech network."""
        convolutions = [
            self[f"{prefix}feature_extractor.conv_layers.{i}.conv.weight"].shape
            for i in range(max(1, self.count(f"{prefix}feature_extractor.conv_layers.")))
        ]
        sizes: dict[str, Any] = {name: self.size(prefix + tensor, axis) for name, (tensor, axis) in BACKBONE.items()}
        large = f"{prefix}feature_extractor.conv_layers.1.layer_norm.weight" in self.tensors
        sizes |= {
            "num_hidden_layers": self.count(f"{prefix}encoder.layers."),
            "conv_dim": [shape[0] for shape in convolutions],
            "conv_kernel": [shape[2] for shape in convolutions],
            "num_feat_extract_layers": len(convolutions),
            "conv_bias": f"{prefix}feature_extractor.conv_layers.0.conv.bias" in self.tensors,
            "feat_extract_norm": "layer" if large else "group",
            "num_conv_pos_embedding_groups": sizes["hidden_size"]
            // self.size(prefix + BACKBONE["num_conv_pos_embeddings"][0], 1),
            "model_type": "wavlm"
            if f"{prefix}encoder.layers.0.attention.rel_attn_embed.weight" in self.tensors
            else kind,
        }
        config = {"do_stable_layer_norm": large, **stated, **sizes}
        follow = {"num_attention_heads": sizes["hidden_size"] % 64 == 0, "conv_stride": len(convolutions) == 7}
        for name, follows in follow.items():
            if name not in config and not follows:
                raise OptionError.naming(
                    f"{self.source}: {name} does not follow from {sizes['hidden_size']} channels and "
                    f"{len(convolutions)} convolutions; give {{audio_config}} config.json with it"
                )
        config.setdefault("num_attention_heads", sizes["hidden_size"] // 64)
        # The network has a place for the vector that SpecAugment writes on masked steps only where it is to mask.
        masked = f"{prefix}masked_spec_embed" in self.tensors
        if not masked or not (config.get("mask_time_prob") or config.get("mask_feature_prob")):
            config |= {"mask_time_prob": 0.05 * masked, "mask_feature_prob": 0.0}
        return config

    def encoder(self, stated: Mapping[str, Any] | None, settings: Mapping[str, Any]) -> partial[Any]:
        """The audio encoder of the tensors."""
        config = self.speech_network("audio_encoder", stated)
        spec_augment = bool(settings.get("spec_augment")) and "audio_encoder.network.masked_spec_embed" in self.tensors
        return partial(Wav2Vec2Encoder, config=config, **{**settings, "spec_augment": spec_augment})

    def renamed(self) -> dict[str, Tensor]:
        """The tensors by the model's names; one that no rename fits keeps its name."""
        result: dict[str, Tensor] = {}
        for name, value in self.tensors.items():
            new = (
                name
                if name.startswith(tuple(f"{into}.network." for into in self.card.encoders))
                else renamed(name, self.card.renames)
            )
            if self.card.layers and new.startswith(self.card.layers):
                new = renamed(new, LAYER_NAMES)
            result[new] = value.T.contiguous() if new in self.card.transposed else value
        return result


def renamed(name: str, renames: Renames) -> str:
    """A name after all renames.

    >>> renamed("layers.0.linear1.bias", LAYER_NAMES)
    'layers.0.first.bias'
    """
    for pattern, replacement in renames:
        name = re.sub(pattern, replacement, name)
    return name


@dataclass
class Facts:
    """Facts that no tensor holds: the faces that a checkpoint animates, and how.

    Attributes:
        dataset: of its training.
        frame_rate: frames a second.
        identities: training identities in the order of the table's rows.
        templates: neutral faces (points, dims) by name.
        space: of the motion.
        unit: unit of length.
        licences: of the data; the corpus's if empty.
        notes: for the user.
        details: values with which the method reads the tensors.
    """

    dataset: str
    frame_rate: float
    identities: list[str]
    templates: dict[str, Tensor]
    space: Space = VERTICES
    unit: str = "m"
    licences: tuple[Licence, ...] = ()
    notes: list[str] = field(default_factory=list)
    details: dict[str, Any] = field(default_factory=dict)

    def sizes(self) -> dict[str, Any]:
        """The options of a model that follow from its data."""
        points = len(next(iter(self.templates.values())))
        space = {} if self.space.is_vertices else {"space": self.space}
        return {"n_vertices": points, "identities": self.identities, "frame_rate": self.frame_rate, **space}


def identities_of(identities: Sequence[str] | None, count: int, defaults: list[str]) -> list[str]:
    """The training identities: the user's, or the data set's."""
    names = defaults if identities is None else list(identities)
    if (count and len(names) != count) or len(set(names)) < len(names) or not all(map(is_name, names)):
        raise OptionError.naming(
            f"{{identities}}: {len(names)} names are {'usual' if identities is None else 'given'}; expected "
            f"{count or len(names)} different ones without path separators, in the order of the training command"
        )
    return names
