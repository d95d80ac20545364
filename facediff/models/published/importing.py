"""Checkpoints of the methods' own projects, as models of facediff.

A project's file holds tensors by name and little else. Which method it is follows from the names, all sizes from the
shapes; what no file holds (whose rows the identities are, the neutral faces, the data set where its size is unusual) is
asked for. Each method has a :class:`Recogniser` next to its model, which says what becomes of every tensor: it is used,
or reported as not needed. Nothing of a file is run.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
import yaml
from torch import Tensor

from facediff import registry
from facediff.data import Assets
from facediff.data.batch import ASSETS_KEY
from facediff.data.corpus import read_templates
from facediff.errors import FaceDiffError, choices
from facediff.metrics import Region
from facediff.models.checkpoint import check_weights
from facediff.models.speech_networks import Wav2Vec2Encoder
from facediff.registry import component_class
from facediff.utils.licences import Commercial, Licence, merged, network_licences
from facediff.utils.limits import FRAME_RATES, quoted
from facediff.utils.plain_files import load_json
from facediff.utils.plain_options import as_hinted, fits, in_words, is_name, parameters
from facediff.utils.tensorflow_files import read_bundle
from facediff.utils.torch_files import read_state_dict

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel

Dataset = Literal["vocaset", "biwi", "multiface"]


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
class Request:
    """What the user says besides the checkpoint; see :func:`import_checkpoint`."""

    dataset: str | None = None
    identities: Sequence[str] | None = None
    audio_config: Mapping[str, Any] | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    graph: Path | None = None


class Weights:
    """The tensors of some files, of which each must be used or reported.

    Args:
        tensors: by the authors' names.
        source: the files, for messages.

    Attributes:
        made: tensors by the names of facediff's model.
        ignored: why tensors are not needed, by the authors' names.
        notes: what the user should know of them.
    """

    def __init__(self, tensors: Mapping[str, Tensor], source: str) -> None:
        self.source = source
        self.tensors = dict(tensors)
        self.made: dict[str, Tensor] = {}
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
        if new in self.made:
            raise FaceDiffError(
                f"{self.source}: holds {self._origins[new]} and {old}, which are the same tensor; expected one of them"
            )
        self.made[new] = self.get(old)
        self._origins[new] = old

    def authors_name(self, new: str) -> str:
        """What the authors call a tensor; a missing one is called by those next to it, else as the model does.

        >>> weights = Weights({"vertice_map.weight": torch.ones(1)}, "vocaset.pth")
        >>> weights.move("vertice_map.weight", "network.motion_in.weight")
        >>> weights.authors_name("network.motion_in.bias")
        'vertice_map.bias'
        """
        if new in self._origins:
            return self._origins[new]
        place, _, kind = new.rpartition(".")
        for there, old in self._origins.items():
            beside, _, other = there.rpartition(".")
            if beside == place and old.endswith(other):
                return f"{old.removesuffix(other)}{kind}"
        return new

    def move_all(self, old: str, new: str, renames: Iterable[tuple[str, str]] = ()) -> None:
        """Use all tensors whose names begin with ``old`` under names that begin with ``new``.

        Args:
            old: how the authors' names begin.
            new: what that becomes.
            renames: parts of the rest of a name and what becomes of them, each applied in turn.
        """
        for name in self.names(old):
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
        kind: Literal["wav2vec2", "hubert"],
        request: Request,
        **settings: Any,  # noqa: ANN401
    ) -> Callable[..., Any]:
        """Use a complete wav2vec 2.0 or HuBERT under ``audio_encoder``, and give the encoder that it belongs to.

        Args:
            prefix: how its names begin, with the dot.
            kind: which network it is.
            request: may hold the network's configuration; else it follows from the shapes.
            settings: options of the encoder, such as ``epsilon``.
        """
        config = backbone_config(self, prefix, kind, request.audio_config)
        old = ("weight_g", "parametrizations.weight.original0"), ("weight_v", "parametrizations.weight.original1")
        self.move_all(prefix, "audio_encoder.network.", old)
        if f"{prefix}masked_spec_embed" not in self:
            config.update(mask_time_prob=0.0, mask_feature_prob=0.0)
            settings["spec_augment"] = False
        return partial(Wav2Vec2Encoder, config=config, **settings)


def backbone_config(weights: Weights, prefix: str, kind: str, given: Mapping[str, Any] | None) -> dict[str, Any]:
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
    found: dict[str, Any] = {
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
    config = {name: value for name, value in (given or {}).items() if isinstance(name, str)}
    for name, value in found.items():
        if name in config and config[name] != value and list_of(config[name]) != value:
            raise FaceDiffError(
                f"--audio-config: its {name} is {quoted(config[name])}, and the tensors of {weights.source} say "
                f"{value}; give the config.json of the very network"
            )
    config = {"do_stable_layer_norm": large, "mask_time_prob": 0.05, **config, **found, "model_type": kind}
    if "num_attention_heads" not in config:
        if hidden % 64:
            raise FaceDiffError(
                f"{weights.source}: its audio encoder has {hidden} channels, from which the number of its attention "
                f"heads does not follow; give --audio-config config.json with num_attention_heads"
            )
        config["num_attention_heads"] = hidden // 64
    if "conv_stride" not in config and len(convolutions) != 7:
        raise FaceDiffError(
            f"{weights.source}: its audio encoder has {len(convolutions)} convolutions, whose strides do not follow "
            f"from it; give --audio-config config.json with conv_stride"
        )
    if not config["mask_time_prob"] and not config.get("mask_feature_prob"):
        config["mask_time_prob"] = 0.05  # otherwise the network has no place for masked_spec_embed
    return config


def conv_names(weights: Weights, prefix: str) -> list[str]:
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
class Recogniser:
    """How a method's checkpoints are known, and what becomes of them.

    Attributes:
        method: the model's registered name.
        marks: tensors that all of its checkpoints have, by the authors' names.
        unless: beginnings of names that none of them has.
        convert: makes the model's options, but for those that every model has, and uses or ignores the tensors.
        vertices: the number of vertices by the tensors' shapes.
        count: the number of training identities by the tensors' shapes; 0 where the method knows no identities.
        frame_rate: frames a second that its checkpoints animate, where they are not those of the data set; the option
            ``frame_rate`` then says otherwise.
        graph: the option that names the frozen graph that the method needs as well; empty if it needs none.
        licence: of the authors' weights.
        commercial: whether that licence allows commercial use.
        licence_source: where it stands.
    """

    method: str
    marks: tuple[str, ...]
    unless: tuple[str, ...]
    convert: Callable[[Weights, Request, Found], dict[str, Any]]
    vertices: Callable[[Weights], int]
    count: Callable[[Weights], int]
    frame_rate: float | None = None
    graph: str = ""
    licence: str = "unknown"
    commercial: Commercial = "unknown"
    licence_source: str = ""

    def knows(self, weights: Weights) -> bool:
        """Whether the tensors are those of this method."""
        return all(name in weights for name in self.marks) and not any(map(weights.names, self.unless))


@dataclass(frozen=True)
class Found:
    """What has been found out before a recogniser converts.

    Attributes:
        dataset: the data set's name; empty if it is none of those that are known.
        frame_rate: frames a second.
        identities: of the table's rows.
        n_vertices: vertices.
    """

    dataset: str
    frame_rate: float
    identities: list[str]
    n_vertices: int


RECOGNISERS: list[Recogniser] = []
"""All that there are; :func:`recogniser` adds one."""


def recogniser(entry: Recogniser) -> Recogniser:
    """Register how a method's checkpoints are known."""
    RECOGNISERS.append(entry)
    return entry


@dataclass(frozen=True)
class Imported:
    """A model made of an author's checkpoint.

    Attributes:
        model: ready for inference.
        dataset: what it was trained on.
        used: how many tensors it uses.
        ignored: why tensors are not needed, by the authors' names.
        notes: what the user should know.
    """

    model: AnimationModel
    dataset: str
    used: int
    ignored: dict[str, str]
    notes: list[str]


def import_checkpoint(
    paths: str | Path | Sequence[str | Path],
    *,
    dataset: str | None = None,
    identities: Sequence[str] | None = None,
    templates: str | Path | Mapping[str, Any] | None = None,
    regions: str | Path | None = None,
    mesh: str | Path | None = None,
    audio_config: str | Path | Mapping[str, Any] | None = None,
    **options: Any,  # noqa: ANN401
) -> AnimationModel:
    """An author's checkpoint of one of the published methods as a model.

    Args:
        paths: the file, or the files of a method with several stages; of TensorFlow's checkpoints the ``.index``, the
            ``.data-…`` or what both names begin with, and the frozen graph (``.pb``) that the method needs.
        dataset: ``vocaset``, ``biwi`` or ``multiface``; by the number of vertices if None.
        identities: training identities in the order of the training command; the data set's usual ones if None.
        templates: neutral faces by speaker: the project's ``templates.pkl``, or arrays (V, 3) or (3V,) by name.
        regions: folder with ``lve.txt`` and ``fdd.txt``, the vertices of lips and upper face.
        mesh: the data set's mesh, for triangles.
        audio_config: ``config.json`` of an audio encoder of unusual size, or its content.
        options: of the model or its audio encoder, such as ``num_heads=4`` or ``long_speech="extend"``; and
            ``ignore``, beginnings of the names of tensors that are left out.

    Raises:
        FaceDiffError: if a file cannot be read, is of no known method, or lacks something that is not given.

    Example:
        >>> model = import_checkpoint("vocaset.pth", templates="templates.pkl")  # doctest: +SKIP
        >>> model.animate(speech, identity="FaceTalk_170809_00138_TA", condition=model.identities[2])  # doctest: +SKIP
    """
    return import_files(
        paths,
        dataset=dataset,
        identities=identities,
        templates=templates,
        regions=regions,
        mesh=mesh,
        audio_config=audio_config,
        **options,
    ).model


def import_files(
    paths: str | Path | Sequence[str | Path],
    *,
    dataset: str | None = None,
    identities: Sequence[str] | None = None,
    templates: str | Path | Mapping[str, Any] | None = None,
    regions: str | Path | None = None,
    mesh: str | Path | None = None,
    audio_config: str | Path | Mapping[str, Any] | None = None,
    **options: Any,  # noqa: ANN401
) -> Imported:
    """As :func:`import_checkpoint`, with a report of what became of the files."""
    files = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    weights = read_weights([path for path in files if path.suffix != GRAPH])
    method = recognise(weights)
    own = {name: value for name, value in options.items() if name not in ("ignore", method.graph)}
    graph = the_graph([path for path in files if path.suffix == GRAPH], options.get(method.graph), method)
    request = Request(dataset, identities, read_config(audio_config), own, graph)
    found = facts_of(weights, method, request)
    made = method.convert(weights, request, found)
    ignore = options.get("ignore", ())
    for prefix in [ignore] if isinstance(ignore, str) else ignore:
        weights.ignore(prefix, "left out as asked")
    if left := weights.left():
        raise FaceDiffError(
            f"{weights.source}: holds tensors that {method.method} has no use for ({listed(left)}); is it a variant "
            f"of the method? If they may be left out, give --option ignore={left[0]}"
        )
    assets, notes = read_assets(found, templates, regions, mesh)
    model = build(weights, method, found, with_options(method.method, made, request.options))
    model.adopt(assets)
    label(model, method, found.dataset)
    return Imported(model.eval(), found.dataset, len(weights.made), weights.ignored, [*weights.notes, *notes])


GRAPH, META = ".pb", ".meta"
"""Suffixes of TensorFlow's graphs: of a frozen one with its weights, and of one without."""

SHARD = re.compile(r"(.+)\.data-\d{5}-of-\d{5}")
"""Names of files with the bytes of a TensorFlow checkpoint's tensors."""


def the_graph(given: Sequence[Path], option: object, method: Recogniser) -> Path | None:
    """The frozen graph that a method needs, which is a further file, or that of an option.

    Raises:
        FaceDiffError: if there are several, or the method needs none.
    """
    graphs = [*given, *([] if option is None else [Path(str(option))])]
    if graphs and not method.graph:
        raise FaceDiffError(f"{graphs[0]}: is a graph of TensorFlow, which {method.method} does not need; omit it")
    if len(set(graphs)) > 1:
        raise FaceDiffError(f"{graphs[1]}: is the second graph that is given; expected one")
    return graphs[0] if graphs else None


def bundles(files: Sequence[Path]) -> dict[Path, list[Path]]:
    """The files of checkpoints, in their order, each with those that were given of its tensors' bytes.

    A checkpoint of TensorFlow has several files, any of which stands for it, as does what their names begin with.
    """
    found: dict[Path, list[Path]] = {}
    shards = [path for path in files if SHARD.fullmatch(path.name)]
    for path in files:
        named = SHARD.fullmatch(path.name)
        if path.suffix == ".index":
            index = path
        elif named is not None or path.suffix == META:
            name = f"{path.stem if named is None else named[1]}.index"
            index = next((each for each in files if each.name == name), path.with_name(name))
        elif not path.exists() and path.with_name(f"{path.name}.index").is_file():
            index = path.with_name(f"{path.name}.index")
        else:
            found[path] = []
            continue
        found[index] = shards
    return found


def read_weights(files: Sequence[Path]) -> Weights:
    """The tensors of all files together.

    Raises:
        FaceDiffError: if a file cannot be read, or two of them hold the same tensor.
    """
    if not files:
        raise FaceDiffError("import-checkpoint: no checkpoint was given; expected that of a published method")
    together: dict[str, Tensor] = {}
    for path, shards in bundles(files).items():
        state = read_bundle(path, shards) if path.suffix == ".index" else read_state_dict(path)
        if "facediff_format" in state:
            raise FaceDiffError(f"{path}: is a checkpoint of facediff already; use it as it is")
        if twice := sorted(together.keys() & state.keys()):
            raise FaceDiffError(
                f"{path}: holds {twice[0]}, which another file holds as well; give one checkpoint, or the stages of "
                f"one method"
            )
        together |= state
    return Weights(together, ", ".join(map(str, files)))


def recognise(weights: Weights) -> Recogniser:
    """The method that tensors belong to.

    Raises:
        FaceDiffError: if it is none that is known.
    """
    registry.model.load()
    fitting = [entry for entry in RECOGNISERS if entry.knows(weights)]
    if len(fitting) == 1:
        return fitting[0]
    if ASSETS_KEY in weights or any(name.startswith("audio_encoder.network.") for name in weights.tensors):
        raise FaceDiffError(f"{weights.source}: is a checkpoint of facediff already; use it as it is")
    raise FaceDiffError(
        f"{weights.source}: is of no method that can be imported (it holds {listed(list(weights.tensors))}); expected "
        f"a checkpoint of {', '.join(dict.fromkeys(entry.method for entry in RECOGNISERS))}"
    )


def facts_of(weights: Weights, method: Recogniser, request: Request) -> Found:
    """Data set, frame rate and identities: by the shapes, or as the user says.

    Raises:
        FaceDiffError: if they contradict each other, or do not follow.
    """
    known, count, vertices = dataset_facts(), method.count(weights), method.vertices(weights)
    name = request.dataset
    if name is not None and name not in known:
        raise FaceDiffError(f"--dataset {name}: there is no such data set: {choices(name, known)}")
    by_size = next((each for each, facts in known.items() if facts.n_vertices == vertices), None)
    if name is not None and by_size is not None and name != by_size:
        raise FaceDiffError(
            f"--dataset {name}: {weights.source} is of {by_size}, by its {vertices} vertices; omit the option"
        )
    name = name or by_size
    if name is None:
        raise FaceDiffError(
            f"{weights.source}: its {vertices} vertices are those of no known data set; give --dataset "
            f"{'|'.join(known)}, which says at how many frames a second it was trained"
        )
    facts = known[name]
    names = list(request.identities) if request.identities is not None else list(facts.identities)
    if count and len(names) != count:
        where = "--identities: " if request.identities is not None else f"{weights.source}: "
        raise FaceDiffError(
            f"{where}the checkpoint has {count} training identities, and "
            f"{len(names)} {'are given' if request.identities is not None else f'is what {name} usually has'}; "
            f"give --identities with {count} names in the order of the training command"
        )
    if not all(map(is_name, names)) or len(set(names)) < len(names):
        raise FaceDiffError(f"--identities: {quoted(names)}; expected different names without path separators")
    return Found(name, rate_of(facts, method, request), names, vertices)


def rate_of(facts: DatasetFacts, method: Recogniser, request: Request) -> float:
    """Frames a second: those of the data set or of the method, or as the user says where the method lets choose.

    Raises:
        FaceDiffError: if they are no positive number.
    """
    given = read_value(request.options.get("frame_rate")) if method.frame_rate is not None else None
    if given is None:
        return method.frame_rate or facts.frame_rate
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0 < given <= FRAME_RATES[1]:
        raise FaceDiffError(
            f"--option frame_rate={quoted(given)}: expected frames a second, such as {method.frame_rate or 0:g}"
        )
    return float(given)


def read_config(given: str | Path | Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The configuration of an audio encoder.

    Raises:
        FaceDiffError: if the file cannot be read, or holds no options by name.
    """
    if given is None or isinstance(given, Mapping):
        return given
    path, remedy = Path(given), "expected the config.json of the audio encoder"
    content = load_json(path, name=f"--audio-config {path}", remedy=remedy)
    if not isinstance(content, dict):
        raise FaceDiffError(f"--audio-config {path}: holds no options by name; {remedy}")
    return content


def with_options(method: str, made: dict[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """A model's options with those that the user gives, which may be its audio encoder's as well.

    Raises:
        FaceDiffError: if there is no such option, or a value does not fit it.
    """
    own = parameters(registry.model.get(method))
    encoders = parameters(component_class(made["audio_encoder"])) if "audio_encoder" in made else {}
    for name in ("n_vertices", "identities", "frame_rate", "audio_encoder"):
        own.pop(name, None)
    for name in ("dim", "config", "source"):
        encoders.pop(name, None)
    for name, text in given.items():
        if name == "frame_rate" and chooses_rate(method):
            continue
        hints = own if name in own else encoders
        if name not in hints:
            raise FaceDiffError(f"--option {name}: {method} has no such option: {choices(name, [*own, *encoders])}")
        value = read_value(text)
        if not fits(value, hints[name]):
            raise FaceDiffError(f"--option {name}={text}: expected {in_words(hints[name])}")
        value = as_hinted(value, hints[name])
        if name in own:
            made = {**made, name: value}
        else:
            made = {**made, "audio_encoder": partial(made["audio_encoder"], **{name: value})}
    return made


def chooses_rate(method: str) -> bool:
    """Whether the option ``frame_rate`` belongs to a method; :func:`rate_of` reads it."""
    return any(entry.method == method and entry.frame_rate is not None for entry in RECOGNISERS)


SCIENTIFIC = re.compile(r"[-+]?\d+(\.\d*)?[eE][-+]?\d+")
"""Numbers such as 1e-7, which YAML takes for text unless they have a point."""


def read_value(text: object) -> object:
    """A value from the command line: a number, true, false, null, a list of such, or the text itself.

    >>> read_value("1e-7"), read_value("[1, 2]"), read_value("extend")
    (1e-07, [1, 2], 'extend')
    """
    if not isinstance(text, str):
        return text
    if SCIENTIFIC.fullmatch(text):
        return float(text)
    try:
        value: object = yaml.safe_load(text)
    except yaml.YAMLError:
        return text
    plain = int | float | bool | None
    listed = isinstance(value, list) and all(isinstance(item, plain) for item in value)
    return value if listed or isinstance(value, plain) else text


def read_assets(
    found: Found, templates: object, regions: str | Path | None, mesh: str | Path | None
) -> tuple[Assets, list[str]]:
    """Faces and regions of the data set, and notes on what is missing.

    Raises:
        FaceDiffError: if there are no templates, or anything does not fit the number of vertices.
    """
    from facediff.data.corpus import as_template
    from facediff.mesh import read_mesh

    count, notes = found.n_vertices, []
    if templates is None:
        raise FaceDiffError(
            "--templates: no checkpoint holds the neutral faces; give the data set's templates.pkl, as the projects "
            "take it"
        )
    if isinstance(templates, Mapping):
        try:
            faces = {str(name): torch.from_numpy(as_template(value, count)) for name, value in templates.items()}
        except ValueError as error:
            raise FaceDiffError(f"templates: a face {error}; expected ({count}, 3) or ({3 * count},)") from error
    else:
        faces = read_templates(Path(str(templates)), count)
    if not faces:
        raise FaceDiffError(f"--templates {templates}: holds no faces; give the data set's templates.pkl")
    everything = torch.arange(count)
    indices = {"lips": everything, "upper_face": everything}
    if regions is None:
        notes.append(
            "no --regions: until it is tested on a corpus, its lips and upper face stand for all vertices, so scores "
            "by region mean nothing"
        )
    else:
        for name, file in (("lips", "lve.txt"), ("upper_face", "fdd.txt")):
            indices[name] = read_region(Path(regions) / file, count)
    triangles = colours = None
    if mesh is None:
        notes.append("no --mesh: its faces have no triangles, so they can be written but not drawn")
    else:
        drawn = read_mesh(Path(mesh))
        if len(drawn.vertices) != count:
            raise FaceDiffError(f"--mesh {mesh}: has {len(drawn.vertices)} vertices, the checkpoint {count}")
        triangles = torch.as_tensor(drawn.faces).long()
    unit = dataset_facts()[found.dataset].unit
    if count != dataset_facts()[found.dataset].n_vertices:
        unit = "m"
    assets = Assets(
        corpus=found.dataset,
        synthetic=False,
        unit=unit,
        frame_rate=found.frame_rate,
        identities=found.identities,
        templates=faces,
        faces=triangles,
        colours=colours,
        regions=indices,
    )
    return assets, notes


def read_region(path: Path, n_vertices: int) -> Tensor:
    """Indices of a region's vertices.

    Raises:
        FaceDiffError: if the file cannot be read, or names vertices that do not exist.
    """
    try:
        region = Region.from_file(path, n_vertices=n_vertices)
    except ValueError as error:
        raise FaceDiffError(f"--regions {path.parent}: {error}") from error
    return torch.tensor(region.indices)


def build(weights: Weights, method: Recogniser, found: Found, options: dict[str, Any]) -> AnimationModel:
    """The model with the authors' weights.

    Raises:
        FaceDiffError: if a tensor is missing or of another shape.
    """
    model: AnimationModel = registry.model.get(method.method)(
        n_vertices=found.n_vertices, identities=found.identities, frame_rate=found.frame_rate, **options
    )
    own = model.state_dict()
    for name, value in own.items():
        if name not in weights.made:
            raise FaceDiffError(
                f"{weights.source}: lacks the tensor {weights.authors_name(name)}; give the checkpoint of the whole "
                f"model, as its authors distribute it"
            )
        if weights.made[name].shape != value.shape:
            raise FaceDiffError(
                f"{weights.source}: its tensor {weights.authors_name(name)} has the shape "
                f"{tuple(weights.made[name].shape)}, expected {tuple(value.shape)}; it does not fit the other tensors, "
                f"or an option"
            )
    if extra := [weights.authors_name(name) for name in sorted(weights.made.keys() - own.keys())]:
        raise FaceDiffError(
            f"{weights.source}: {method.method} has no place for {listed(extra)}; it does not fit the other tensors"
        )
    check_weights(weights.source, weights.made, own)
    model.load_state_dict({name: value.to(own[name].dtype) for name, value in weights.made.items()})
    for name, parameter in model.named_parameters():
        if not parameter.isfinite().all():
            raise FaceDiffError(
                f"{weights.source}: its tensor {weights.authors_name(name)} holds NaN or infinity; the file is damaged"
            )
    return model


def label(model: AnimationModel, method: Recogniser, dataset: str) -> None:
    """Keep the data set's class with the model, and the licences of weights, data set and pretrained network.

    By the class, ``facediff test`` knows what to read; where its folder is, no checkpoint knows.
    """
    corpora: list[Any] = [entry.implementation for entry in registry.corpus]
    known = next((each for each in corpora if each.corpus_name == dataset), None)
    data = known.corpus_licence() if known is not None else Licence(f"corpus {dataset}")
    if known is not None:
        model.data_source = {"class_path": f"{known.__module__}.{known.__qualname__}"}
    weights = Licence(f"weights of {method.method}", method.licence, method.commercial, method.licence_source)
    model.licences = merged([weights], [data], network_licences(dict(model.hparams)))


def listed(names: Sequence[str]) -> str:
    """Some names for a message."""
    shown = ", ".join(quoted(name).strip("'") for name in names[:3])
    return shown if len(names) <= 3 else f"{shown} and {len(names) - 3} more"


def save_model(model: AnimationModel, path: Path) -> None:
    """Write a model as a checkpoint, in the form in which training writes one.

    Raises:
        FaceDiffError: if the file cannot be written.
    """
    from lightning.pytorch import Trainer

    from facediff.utils.files import atomic

    # It would advertise services, and report devices that nothing is computed on.
    announcements = logging.getLogger("lightning.pytorch")
    level = announcements.level
    announcements.setLevel(logging.ERROR)
    try:
        trainer = Trainer(
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
        )
    finally:
        announcements.setLevel(level)
    trainer.strategy.connect(model)
    with atomic(path) as temporary:
        trainer.save_checkpoint(temporary, weights_only=True)
