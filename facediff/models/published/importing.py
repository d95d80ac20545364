"""Checkpoints of the methods' own projects, as models of facediff.

A project's file holds tensors by name and little else. Which method it is follows from the names, all sizes from the
shapes; what no file holds (whose rows the identities are, the neutral faces, the data set where its size is unusual) is
asked for. Each method has a :class:`Recogniser` next to its model, which says what becomes of every tensor: it is used,
or reported as not needed. Nothing of a file is run.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
import yaml
from torch import Tensor

from facediff import registry
from facediff.data import Assets
from facediff.data.batch import ASSETS_KEY
from facediff.data.corpus import read_templates
from facediff.errors import FaceDiffError, OptionError, choices
from facediff.hyperparameters import component_class
from facediff.metrics import Region
from facediff.models.checkpoint_content import IMPORTED, check_weights
from facediff.models.published.import_options import ImportOptions
from facediff.models.published.recognition import (
    RECOGNISERS,
    AuthorsWeights,
    CheckpointFacts,
    DatasetFacts,
    FaceFacts,
    Recogniser,
    dataset_facts,
)
from facediff.spaces.layouts import layout
from facediff.utils import hints
from facediff.utils.arrays import read_arrays
from facediff.utils.hints import is_name, options_of
from facediff.utils.licences import Licence, merged, network_licences
from facediff.utils.limits import FRAME_RATES, quoted
from facediff.utils.plain_files import load_json
from facediff.utils.torch_files import read_authors_checkpoint

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel


@dataclass(frozen=True)
class Imported:
    """A model converted from an author's checkpoint.

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


def import_checkpoint(paths: str | Path | Sequence[str | Path], **options: Any) -> AnimationModel:  # noqa: ANN401
    """An author's checkpoint of one of the published methods as a model.

    Args:
        paths: the file, or the files of a method with several stages; of TensorFlow's checkpoints and
            graphs those (``.npz``) of ``tools/convert_tensorflow.py``.
        options: fields of :class:`~facediff.models.published.import_options.ImportOptions`, such as ``templates``; and
            options of the model or its audio encoder, such as ``num_heads=4`` or ``long_speech="extend"``.

    Raises:
        FaceDiffError: if a file cannot be read, is of no known method, or lacks something that is not given.

    Example:
        >>> model = import_checkpoint("vocaset.pth", templates="templates.pkl")  # doctest: +SKIP
        >>> model.animate(speech, identity="FaceTalk_170809_00138_TA", condition=model.identities[2])  # doctest: +SKIP
    """
    return import_files(paths, ImportOptions.of(options)).model


def import_files(paths: str | Path | Sequence[str | Path], options: ImportOptions) -> Imported:
    """As :func:`import_checkpoint`, with a report of what became of the files."""
    files = [Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths]
    graphs = [path for path in files if is_graph(path)]
    weights = read_weights([path for path in files if path not in graphs])
    method = recognise(weights)
    refuse_idle(options, method)
    options, unused = options.with_hparams()
    facts, own = facts_and_faces(weights, method, options, graphs)
    converted = convert(weights, method, facts, options)
    if left := weights.left():
        raise OptionError.naming(
            f"{weights.source}: holds tensors that {method.method} has no use for ({listed(left)}); is it a variant "
            f"of the method? If they may be left out, give {{option}} ignore={left[0]}"
        )
    assets, notes = read_assets(facts, options) if own is None else own_assets(own, options)
    if unused:
        notes.append(f"hparams: not needed, or read from the tensors: {', '.join(unused)}")
    model = build(weights, method, facts, with_options(method.method, converted, facts.model_options))
    model.adopt(assets)
    label(model, method, facts.dataset, () if own is None else own.licences)
    return Imported(model.eval(), facts.dataset, len(weights.renamed), weights.ignored, [*weights.notes, *notes])


def convert(
    weights: AuthorsWeights, method: Recogniser, facts: CheckpointFacts, options: ImportOptions
) -> dict[str, Any]:
    """The model's options; every tensor is used, or left out as the user asks, or left."""
    ignore = options.all_model_options().get("ignore", ())
    converted = method.convert(weights, facts)
    for prefix in [ignore] if isinstance(ignore, str) else ignore:
        weights.ignore(prefix, "left out as asked")
    return converted


NO_EFFECT = "does not read this option, which would have no effect; omit it"


def refuse_idle(options: ImportOptions, method: Recogniser) -> None:
    """Refuse options that a method does not read; a file of hyper-parameters may hold them, being for many methods.

    Raises:
        FaceDiffError: naming the first one.
    """
    of_vertices = ("dataset", "identities", "templates", "regions", "mesh")
    if method.faces is not None:
        read = method.reads
    elif method.layout:
        read = ("identities", "mesh") if layout(method.layout).kind == "flame" else ("identities",)
    else:
        read = of_vertices
    for name in (*of_vertices, "statistics", "data_root", "template_row"):
        if getattr(options, name) is not None and name not in read:
            raise OptionError.naming(f"{{{name}}}: {method.method} {NO_EFFECT}")


def facts_and_faces(
    weights: AuthorsWeights, method: Recogniser, options: ImportOptions, graphs: Sequence[Path]
) -> tuple[CheckpointFacts, FaceFacts | None]:
    """What is known of a checkpoint, and the faces of a method that has its own.

    Raises:
        FaceDiffError: if something does not follow from the tensors and the options, or contradicts them.
    """
    if method.faces is None:
        return facts_of(weights, method, options, graphs), None
    the_graph(graphs, None, method)
    own = method.faces(weights, options)
    return own_facts(own, method, options), own


def the_graph(files: Sequence[Path], option: object, method: Recogniser) -> Path | None:
    """The frozen graph that a method needs, which is a further file, or that of an option.

    Raises:
        FaceDiffError: if there are several, or the method needs none.
    """
    graphs = [*files, *([] if option is None else [Path(str(option))])]
    if graphs and not method.graph:
        raise FaceDiffError(f"{graphs[0]}: is a graph of TensorFlow, which {method.method} does not need; omit it")
    if len(set(graphs)) > 1:
        raise FaceDiffError(f"{graphs[1]}: is the second graph that is given; expected one")
    return graphs[0] if graphs else None


def is_graph(path: Path) -> bool:
    """Whether a file of arrays by name holds DeepSpeech's graph: its first layer is called ``h1``."""
    return path.suffix == ".npz" and any(name.rpartition("/")[2] == "h1" for name in read_arrays(path))


def read_weights(files: Sequence[Path]) -> AuthorsWeights:
    """The tensors of all files together.

    Raises:
        FaceDiffError: if a file cannot be read, or two of them hold the same tensor.
    """
    if not files:
        raise FaceDiffError("import-checkpoint: no checkpoint was given; expected that of a published method")
    together: dict[str, Tensor] = {}
    arguments: dict[str, Mapping[str, Any]] = {}
    for path in files:
        state, options = read_authors_checkpoint(path)
        if "facediff_format" in state:
            raise FaceDiffError(f"{path}: is a checkpoint of facediff already; use it as it is")
        if twice := sorted(together.keys() & state.keys()):
            raise FaceDiffError(
                f"{path}: holds {twice[0]}, which another file holds as well; give one checkpoint, or the stages of "
                f"one method"
            )
        together |= state
        if options:
            arguments |= dict.fromkeys(state, options)
    return AuthorsWeights(together, ", ".join(map(str, files)), arguments)


def recognise(weights: AuthorsWeights) -> Recogniser:
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


def facts_of(
    weights: AuthorsWeights, method: Recogniser, options: ImportOptions, graphs: Sequence[Path]
) -> CheckpointFacts:
    """Data set, frame rate and identities: by the shapes, or as the user says.

    Raises:
        FaceDiffError: if they contradict each other, or do not follow.
    """
    if method.layout:
        the_graph(graphs, None, method)
        return parametric_facts(weights, method, options)
    datasets, count, vertices = dataset_facts(), method.count(weights), method.vertices(weights)
    name: str | None = options.dataset
    if name is not None and name not in datasets:
        raise OptionError.naming(f"{{dataset}} {name}: there is no such data set: {choices(name, datasets)}")
    by_size = next((dataset for dataset, facts in datasets.items() if facts.n_vertices == vertices), None)
    if name is not None and by_size is not None and name != by_size:
        raise OptionError.naming(
            f"{{dataset}} {name}: {weights.source} is of {by_size}, by its {vertices} vertices; omit the option"
        )
    name = name or by_size
    if name is None:
        raise OptionError.naming(
            f"{weights.source}: its {vertices} vertices are those of no known data set; give {{dataset}} "
            f"{'|'.join(datasets)}, which says at how many frames a second it was trained"
        )
    identities = list(datasets[name].identities if options.identities is None else options.identities)
    if count and len(identities) != count:
        where = "--identities: " if options.identities is not None else f"{weights.source}: "
        raise OptionError.naming(
            f"{where}the checkpoint has {count} training identities, and "
            f"{len(identities)} {'are given' if options.identities is not None else f'is what {name} usually has'}; "
            f"give {{identities}} with {count} names in the order of the training command"
        )
    check_names(identities)
    asked = options.all_model_options()
    return CheckpointFacts(
        dataset=name,
        frame_rate=rate_of(datasets[name], method, asked.get("frame_rate")),
        identities=identities,
        n_vertices=vertices,
        audio_config=read_config(options.audio_config),
        model_options={key: value for key, value in asked.items() if key not in ("ignore", method.graph)},
        graph=the_graph(graphs, asked.get(method.graph), method),
    )


def parametric_facts(weights: AuthorsWeights, method: Recogniser, options: ImportOptions) -> CheckpointFacts:
    """The facts of a method that animates channels: its layout says what they are.

    Raises:
        FaceDiffError: if the tensors have another number of channels or identities, or a file of hyper-parameters names
            a data set.
    """
    if options.dataset is not None:
        raise OptionError.naming(f"{{dataset}}: {method.method} {NO_EFFECT}")
    space, channels, count = layout(method.layout), method.vertices(weights), method.count(weights)
    if channels != len(space.channels):
        raise FaceDiffError(
            f"{weights.source}: gives {channels} channels, and {method.method} has {len(space.channels)} "
            f"({method.layout}); expected a checkpoint as its authors distribute it"
        )
    identities = [str(number) for number in range(max(1, count))]
    if options.identities is not None:
        identities = list(options.identities)
        if count and len(identities) != count:
            raise OptionError.naming(f"{{identities}}: are {len(identities)}, and the checkpoint has {count}")
        check_names(identities)
    asked = options.all_model_options()
    return CheckpointFacts(
        dataset=method.method,
        frame_rate=rate_of(DatasetFacts(channels, method.frame_rate or 0.0, (), "m"), method, asked.get("frame_rate")),
        identities=identities,
        n_vertices=channels,
        space=space,
        audio_config=read_config(options.audio_config),
        model_options={key: value for key, value in asked.items() if key != "ignore"},
    )


def check_names(identities: Sequence[str]) -> None:
    """Refuse names of identities that are none, or occur twice."""
    if not all(map(is_name, identities)) or len(set(identities)) < len(identities):
        raise OptionError.naming(
            f"{{identities}}: {quoted(identities)}; expected different names without path separators"
        )


def own_facts(faces: FaceFacts, method: Recogniser, options: ImportOptions) -> CheckpointFacts:
    """What is known of the checkpoint of a method with faces of its own."""
    asked = options.all_model_options()
    return CheckpointFacts(
        dataset=faces.corpus,
        frame_rate=faces.frame_rate,
        identities=faces.identities,
        n_vertices=faces.n_points,
        audio_config=read_config(options.audio_config),
        model_options={key: value for key, value in asked.items() if key != "ignore"},
        space=faces.space,
        details=faces.details,
    )


def own_assets(faces: FaceFacts, options: ImportOptions) -> tuple[Assets, list[str]]:
    """Assets of such a method, and notes on them.

    Raises:
        FaceDiffError: if a mesh does not fit its vertices, or is given for channels of another kind than FLAME's.
    """
    if options.mesh is not None and not faces.space.is_vertices and faces.space.kind != "flame":
        raise OptionError.naming(f"{{mesh}}: {faces.corpus} animates channels without a mesh; omit it")
    everything = torch.arange(faces.n_points)
    named = {name: torch.tensor(faces.space.region(name), dtype=torch.long) for name in ("lips", "upper_face")}
    regions = {name: indices if len(indices) else everything for name, indices in named.items()}
    assets = Assets(
        corpus=faces.corpus,
        synthetic=False,
        unit=faces.unit,
        frame_rate=faces.frame_rate,
        identities=faces.identities,
        templates=faces.templates,
        faces=read_triangles(options.mesh, faces.n_points) if faces.space.is_vertices else None,
        colours=None,
        regions=regions,
        space=faces.space,
    )
    return with_flame(assets, options.mesh), list(faces.notes)


def with_flame(assets: Assets, mesh: Path | None) -> Assets:
    """Assets in FLAME's parameters with the user's FLAME model as rig, so that they can be drawn.

    Raises:
        FaceDiffError: if the file is no FLAME model.
    """
    if mesh is None or assets.space.kind != "flame":
        return assets
    from facediff.data.batch import Rig
    from facediff.mesh.flame import Flame
    from facediff.spaces.rigs import flame_rig

    return replace(assets, rig=Rig.of(flame_rig(Flame.read(Path(mesh)), jaw=True), assets))


def read_triangles(mesh: Path | None, count: int) -> Tensor | None:
    """The triangles of a mesh, if there is one.

    Raises:
        FaceDiffError: if it has another number of vertices.
    """
    from facediff.mesh import read_mesh

    if mesh is None:
        return None
    drawn = read_mesh(Path(mesh))
    if len(drawn.vertices) != count:
        raise OptionError.naming(f"{{mesh}} {mesh}: has {len(drawn.vertices)} vertices, the checkpoint {count}")
    return torch.as_tensor(drawn.faces).long()


def rate_of(dataset: DatasetFacts, method: Recogniser, option: object) -> float:
    """Frames a second: those of the data set or of the method, or as the user says where the method lets choose.

    Raises:
        FaceDiffError: if they are no positive number.
    """
    rate = read_value(option) if method.frame_rate is not None else None
    if rate is None:
        return method.frame_rate or dataset.frame_rate
    if isinstance(rate, bool) or not isinstance(rate, int | float) or not 0 < rate <= FRAME_RATES[1]:
        raise OptionError.naming(
            f"{{option}} frame_rate={quoted(rate)}: expected frames a second, such as {method.frame_rate or 0:g}"
        )
    return float(rate)


def read_config(config: str | Path | Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The configuration of an audio encoder.

    Raises:
        FaceDiffError: if the file cannot be read, or holds no options by name.
    """
    if config is None or isinstance(config, Mapping):
        return config
    path, remedy = Path(config), "expected the config.json of the audio encoder"
    content = load_json(path, name=f"--audio-config {path}", remedy=remedy)
    if not isinstance(content, dict):
        raise OptionError.naming(f"{{audio_config}} {path}: holds no options by name; {remedy}")
    return content


def with_options(method: str, converted: dict[str, Any], chosen: Mapping[str, Any]) -> dict[str, Any]:
    """A model's options with those that the user gives, which may be its audio encoder's as well.

    Raises:
        FaceDiffError: if there is no such option, or a value does not fit it.
    """
    own = options_of(registry.model.get(method))
    encoders = options_of(component_class(converted["audio_encoder"])) if "audio_encoder" in converted else {}
    for name in ("n_vertices", "identities", "frame_rate", "space", "audio_encoder"):
        own.pop(name, None)
    for name in ("dim", "config", "source"):
        encoders.pop(name, None)
    for name, text in chosen.items():
        if name == "frame_rate" and chooses_rate(method):
            continue
        if name not in own and name not in encoders:
            raise OptionError.naming(
                f"{{option}} {name}: {method} has no such option: {choices(name, [*own, *encoders])}"
            )
        value = read_value(text)
        hint = (own if name in own else encoders)[name].annotation
        if not hints.fits(hint, value, stored=True):
            raise OptionError.naming(f"{{option}} {name}={text}: expected {hints.describe(hint)}")
        value = hints.convert(hint, value)
        if name in own:
            converted = {**converted, name: value}
        else:
            converted = {**converted, "audio_encoder": partial(converted["audio_encoder"], **{name: value})}
    return converted


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


def read_assets(facts: CheckpointFacts, options: ImportOptions) -> tuple[Assets, list[str]]:
    """Faces and regions of the data set, and notes on what is missing.

    Raises:
        FaceDiffError: if there are no templates, or anything does not fit the number of vertices.
    """
    from facediff.data.corpus import as_template

    if not facts.space.is_vertices:
        return with_flame(parametric_assets(facts), options.mesh), []
    templates, regions, mesh = options.templates, options.regions, options.mesh
    count, notes = facts.n_vertices, []
    if templates is None:
        raise OptionError.naming(
            "{templates}: no checkpoint holds the neutral faces; give the data set's templates.pkl, as the projects "
            "take it"
        )
    if isinstance(templates, Mapping):
        faces = {
            name: torch.from_numpy(as_template("templates", name, value, count)) for name, value in templates.items()
        }
    else:
        faces = read_templates(Path(templates), count)
    if not faces:
        raise OptionError.naming(f"{{templates}} {templates}: holds no faces; give the data set's templates.pkl")
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
    triangles = read_triangles(mesh, count)
    if triangles is None:
        notes.append("no --mesh: its faces have no triangles, so they can be written but not drawn")
    unit = dataset_facts()[facts.dataset].unit
    if count != dataset_facts()[facts.dataset].n_vertices:
        unit = "m"
    assets = Assets(
        corpus=facts.dataset,
        synthetic=False,
        unit=unit,
        frame_rate=facts.frame_rate,
        identities=facts.identities,
        templates=faces,
        faces=triangles,
        colours=None,
        regions=indices,
    )
    return assets, notes


def parametric_assets(facts: CheckpointFacts) -> Assets:
    """Faces at rest, whose channels are all 0, and the regions by the channels' names."""
    rest = torch.zeros(facts.n_vertices, 1)
    named = {name: torch.tensor(facts.space.region(name), dtype=torch.long) for name in ("lips", "upper_face")}
    regions = {name: channels if len(channels) else torch.arange(len(rest)) for name, channels in named.items()}
    return Assets(
        corpus=facts.dataset,
        synthetic=False,
        unit="m",
        frame_rate=facts.frame_rate,
        identities=facts.identities,
        templates=dict.fromkeys(facts.identities, rest),
        faces=None,
        regions=regions,
        space=facts.space,
    )


def read_region(path: Path, n_vertices: int) -> Tensor:
    """Indices of a region's vertices.

    Raises:
        FaceDiffError: if the file cannot be read, or names vertices that do not exist.
    """
    try:
        region = Region.from_file(path, n_vertices=n_vertices)
    except ValueError as error:
        raise OptionError.naming(f"{{regions}} {path.parent}: {error}") from error
    return torch.tensor(region.indices)


def build(
    weights: AuthorsWeights, method: Recogniser, facts: CheckpointFacts, options: dict[str, Any]
) -> AnimationModel:
    """The model with the authors' weights.

    Raises:
        FaceDiffError: if a tensor is missing or of another shape.
    """
    model: AnimationModel = registry.model.get(method.method)(
        **facts.sizes(),
        **options,
    )
    own = model.state_dict()
    own.pop("geometry", None)  # what channels count in training, which no author's file holds
    for name, value in own.items():
        if name not in weights.renamed:
            raise FaceDiffError(
                f"{weights.source}: lacks the tensor {weights.authors_name(name)}; give the checkpoint of the whole "
                f"model, as its authors distribute it"
            )
        if weights.renamed[name].shape != value.shape:
            raise FaceDiffError(
                f"{weights.source}: its tensor {weights.authors_name(name)} has the shape "
                f"{tuple(weights.renamed[name].shape)}, expected {tuple(value.shape)}; it does not fit the other "
                f"tensors, or an option"
            )
    if extra := [weights.authors_name(name) for name in sorted(weights.renamed.keys() - own.keys())]:
        raise FaceDiffError(
            f"{weights.source}: {method.method} has no place for {listed(extra)}; it does not fit the other tensors"
        )
    check_weights(weights.source, weights.renamed, own)
    renamed = {name: value.to(own[name].dtype) for name, value in weights.renamed.items()}
    model.load_state_dict(model.state_dict() | renamed)
    for name, value in model.state_dict().items():
        if not value.isfinite().all():
            raise FaceDiffError(
                f"{weights.source}: its tensor {weights.authors_name(name)} holds NaN or infinity; the file is damaged"
            )
    return model


def label(model: AnimationModel, method: Recogniser, dataset: str, data_licences: tuple[Licence, ...] = ()) -> None:
    """Keep the data set's class with the model, and the licences of weights, data set and pretrained network.

    By the class, ``facediff test`` knows what to read; where its folder is, no checkpoint knows.
    """
    corpora: list[Any] = [entry.implementation for entry in registry.corpus]
    corpus = next((corpus for corpus in corpora if corpus.corpus_name == dataset), None)
    data = corpus.corpus_licence() if corpus is not None else Licence(f"corpus {dataset}")
    if corpus is not None:
        model.data_source = {"class_path": f"{corpus.__module__}.{corpus.__qualname__}"}
    weights = Licence(f"weights of {method.method}", method.licence, method.commercial, method.licence_source)
    model.provenance = {IMPORTED: method.method}
    model.licences = merged([weights], data_licences or [data], network_licences(dict(model.hparams)))


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
