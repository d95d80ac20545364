"""Checkpoints of the methods' own projects, as models of facediff.

A project's file holds tensors by name and little else. Which method it is follows from the names
(:mod:`facediff.models.published.cards`); what no file holds (whose rows the identities are, the neutral faces, the data
set where its size is unusual) is asked for. Every tensor is used, or reported as not needed. Nothing of a file is run.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from facediff import registry
from facediff.data import Assets
from facediff.data.batch import ASSETS_KEY
from facediff.data.corpus import as_template, read_templates
from facediff.errors import FaceDiffError, OptionError, choices
from facediff.hyperparameters import component_class
from facediff.metrics import Region
from facediff.models.checkpoint_content import IMPORTED
from facediff.models.published.cards import AuthorFiles, Card, Facts, cards
from facediff.models.published.import_options import ImportOptions
from facediff.spaces.layouts import layout
from facediff.utils.hints import is_name, options_of
from facediff.utils.licences import Licence, merged, network_licences
from facediff.utils.plain_files import load_json
from facediff.utils.torch_files import read_authors_checkpoint

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel
    from facediff.models.published.base import PublishedModel


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
        paths: the file, or the files of a method with several stages or networks; of TensorFlow's checkpoints and
            graphs those (``.npz``) of ``tools/convert_tensorflow.py``.
        options: fields of :class:`~facediff.models.published.import_options.ImportOptions`, such as ``templates``; and
            options of the model or its audio encoder, such as ``num_heads=4`` or ``long_speech="extend"``.

    Example:
        >>> model = import_checkpoint("vocaset.pth", templates="templates.pkl")  # doctest: +SKIP
        >>> model.animate(speech, identity="FaceTalk_170809_00138_TA", condition=model.identities[2])  # doctest: +SKIP
    """
    return import_files(paths, ImportOptions.of(options)).model


def import_files(paths: str | Path | Sequence[str | Path], options: ImportOptions) -> Imported:
    """As :func:`import_checkpoint`, with a report of what became of the files."""
    found = convert(paths, options)
    if not found.difference.fits:
        raise FaceDiffError(f"{found.files.source}: does not fit {found.files.card.method}: {found.difference}")
    model, own = found.model, found.model.state_dict()
    model.load_state_dict(own | {name: value.to(own[name].dtype) for name, value in found.weights.items()})
    model.adopt(assets_of(found.facts, options))
    label(model, found.files.card, found.facts)
    return Imported(model.eval(), found.facts.dataset, len(found.weights), found.files.ignored, found.facts.notes)


@dataclass(frozen=True)
class Difference:
    """What differs between the weights of a model and an author's.

    Attributes:
        missing: weights that the files lack, by the model's names.
        unexpected: tensors that the model has no place for.
        misshapen: tensors of another shape or sort, and what was expected.
        not_finite: tensors with NaN or infinity.
    """

    missing: list[str] = field(default_factory=list)
    unexpected: list[str] = field(default_factory=list)
    misshapen: list[str] = field(default_factory=list)
    not_finite: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, model: AnimationModel, weights: Mapping[str, Tensor]) -> Difference:
        """Compare, as ``load_state_dict`` does."""
        own = {name: value for name, value in model.state_dict().items() if name != "geometry"}  # of training alone
        both = own.keys() & weights.keys()
        return cls(
            missing=[f"{name} {tuple(own[name].shape)}" for name in own if name not in weights],
            unexpected=[f"{name} {tuple(weights[name].shape)}" for name in weights if name not in own],
            misshapen=[
                f"{name} {tuple(weights[name].shape)}, expected {tuple(own[name].shape)} {own[name].dtype}"
                for name in sorted(both)
                if weights[name].shape != own[name].shape
                or weights[name].is_floating_point() != own[name].is_floating_point()
            ],
            not_finite=[name for name in sorted(both) if not bool(weights[name].isfinite().all())],
        )

    @property
    def fits(self) -> bool:
        """Whether there is none."""
        return not any(vars(self).values())

    def __str__(self) -> str:
        """The first of each kind, and what to do."""
        found = [
            f"{kind.replace('_', ' ')}: {names[0]} ({len(names)} in all)" for kind, names in vars(self).items() if names
        ]
        return (
            f"{'; '.join(found)}. Print all by --doctor; sizes that no tensor tells are given as --option NAME=VALUE, "
            f"tensors to leave out as --option ignore=PREFIX"
        )


@dataclass(frozen=True)
class Conversion:
    """The model that files ask for, without their weights, and the weights by the model's names."""

    files: AuthorFiles
    facts: Facts
    model: AnimationModel
    weights: dict[str, Tensor]

    @property
    def difference(self) -> Difference:
        """What does not fit."""
        return Difference.of(self.model, self.weights)


def convert(paths: str | Path | Sequence[str | Path], options: ImportOptions) -> Conversion:
    """Read files, and make the model that they ask for."""
    files = read_files([Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths])
    card = files.card
    for name in ("dataset", "identities", "templates", "regions", "mesh", "statistics", "data_root", "template_row"):
        if getattr(options, name) is not None and name not in card.reads:
            raise OptionError.naming(
                f"{{{name}}}: {card.method} does not read this option, which would have no effect; omit it"
            )
    options, unused = options.with_hparams()
    method: type[PublishedModel] = registry.model.get(card.method)
    asked = options.all_model_options()
    for prefix in asked.pop("ignore", []):
        files.ignore(prefix, "left out as asked")
    facts = method.author_facts(files, options) or facts_of(files, options, asked)
    if card.frame_rate:
        asked.pop("frame_rate", None)
    stated = read_config(options.audio_config)
    given = method.read_author(files, facts, {**asked, "audio_config": stated})
    given |= {name: value for name, value in files.sizes().items() if name not in given}
    for prefix, why in card.ignored.items():
        files.ignore(prefix, why)
    files.check_positions(facts.frame_rate, facts.dataset)
    if card.encoders:
        given["audio_encoder"] = files.encoder(stated, method.encoder_settings())
    weights = files.renamed()
    model = method(**facts.sizes(), **with_options(card.method, given, asked))
    if unused:
        facts.notes.append(f"hparams: not needed, or read from the tensors: {', '.join(unused)}")
    return Conversion(files, facts, model, weights)


# Files.


def read_files(paths: Sequence[Path]) -> AuthorFiles:
    """The tensors of all files together, and the card of their method."""
    tensors: dict[str, Tensor] = {}
    arguments: dict[str, Mapping[str, Any]] = {}
    for path in paths:
        state, said = read_authors_checkpoint(path)
        if "facediff_format" in state or ASSETS_KEY in state:
            raise FaceDiffError(f"{path}: is a checkpoint of facediff already; use it as it is")
        if twice := sorted(tensors.keys() & state.keys()):
            raise FaceDiffError(
                f"{path}: holds {twice[0]}, which another file holds as well; give one checkpoint, or the stages of "
                f"one method"
            )
        tensors |= state
        arguments |= dict.fromkeys(state, said)
    source = ", ".join(map(str, paths))
    registry.model.load()
    for card in cards():
        for prefix in (*card.prefixes, ""):
            named = {name.removeprefix(prefix): value for name, value in tensors.items()}
            if card.fits(named):
                return AuthorFiles(named, source, card, arguments)
    nearest = max(cards(), key=lambda card: sum(name in tensors for name in card.required) / len(card.required))
    raise FaceDiffError(
        f"{source}: is of no method that can be imported: {', '.join(dict.fromkeys(card.method for card in cards()))}; "
        f"it holds {', '.join(list(tensors)[:3])} …, and {nearest.method}'s have {', '.join(nearest.required)}"
    )


# What no file says.


@dataclass(frozen=True)
class Dataset:
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


def datasets() -> dict[str, Dataset]:
    """The data sets of the released checkpoints."""
    from facediff.data.biwi import Biwi
    from facediff.data.vocaset import Vocaset

    known = {m.corpus_name: Dataset(m.n_vertices, m.frame_rate, tuple(m.identities), m.unit) for m in (Vocaset, Biwi)}
    identities = ("2", "3", "6", "7", "9", "10", "11", "12", "13")
    return {**known, "multiface": Dataset(6172, 30.0, identities, "0.122")}


def facts_of(files: AuthorFiles, options: ImportOptions, asked: Mapping[str, Any]) -> Facts:
    """Data set, frame rate, identities and neutral faces: by the sizes of the tensors, or as the user says."""
    card, numbers = files.card, files.size(*files.card.coordinates)
    count = files.size(*card.speakers) if card.speakers else 0
    rate = read_value(asked.get("frame_rate", card.frame_rate)) if card.frame_rate else 0.0
    if not isinstance(rate, int | float):
        raise OptionError.naming(f"{{option}} frame_rate={rate}: expected frames a second, such as {card.frame_rate:g}")
    if card.layout:
        space = layout(card.layout)
        if numbers != len(space.channels):
            raise FaceDiffError(
                f"{files.source}: gives {numbers} channels, and {card.method} has {len(space.channels)} ({card.layout})"
            )
        names = identities_of(options.identities, count, [str(number) for number in range(max(1, count))])
        return Facts(card.method, float(rate), names, dict.fromkeys(names, torch.zeros(numbers, 1)), space)
    known, points = datasets(), numbers // 3
    by_size = next((name for name, data in known.items() if data.n_vertices == points), None)
    dataset = options.dataset or by_size
    if dataset is None or dataset not in known or by_size not in (None, dataset):
        raise OptionError.naming(
            f"{{dataset}}: {files.source} has {points} vertices, those of {by_size or 'no known data set'}; give the "
            f"data set that it was trained on, {'|'.join(known)}, which says at how many frames a second"
        )
    data = known[dataset]
    names = identities_of(options.identities, count, list(data.identities))
    templates = templates_of(options.templates, points)
    unit = data.unit if points == data.n_vertices else "m"
    return Facts(dataset, float(rate or data.frame_rate), names, templates, unit=unit)


def identities_of(given: Sequence[str] | None, count: int, usual: list[str]) -> list[str]:
    """The training identities."""
    names = usual if given is None else list(given)
    if (count and len(names) != count) or len(set(names)) < len(names) or not all(map(is_name, names)):
        raise OptionError.naming(
            f"{{identities}}: {len(names)} names are {'usual' if given is None else 'given'}; expected "
            f"{count or len(names)} different ones without path separators, in the order of the training command"
        )
    return names


def templates_of(given: Path | Mapping[str, Any] | None, points: int) -> dict[str, Tensor]:
    """The neutral faces by speaker."""
    if given is None:
        raise OptionError.naming(
            "{templates}: no checkpoint holds the neutral faces; give the data set's templates.pkl, as the projects "
            "take it"
        )
    if not isinstance(given, Mapping):
        faces = read_templates(Path(given), points)
    else:
        faces = {
            str(name): torch.from_numpy(as_template("templates", name, face, points)) for name, face in given.items()
        }
    if not faces:
        raise OptionError.naming("{templates}: holds no faces; give the data set's templates.pkl")
    return faces


def assets_of(facts: Facts, options: ImportOptions) -> Assets:
    """Faces and regions, with notes on what is missing."""
    points = len(next(iter(facts.templates.values())))
    indices = {name: torch.arange(points) for name in ("lips", "upper_face")}
    triangles = None
    if facts.space.is_vertices:
        if options.regions is not None:
            for name, file in (("lips", "lve.txt"), ("upper_face", "fdd.txt")):
                indices[name] = torch.tensor(Region.from_file(Path(options.regions) / file, n_vertices=points).indices)
        elif not facts.details:
            facts.notes.append(
                "no --regions: until it is tested on a corpus, its lips and upper face stand for all vertices, so "
                "scores by region mean nothing"
            )
        triangles = read_triangles(options.mesh, points)
        if triangles is None:
            facts.notes.append("no --mesh: its faces have no triangles, so they can be written but not drawn")
    else:
        channels = {name: facts.space.region(name) for name in indices}
        indices |= {name: torch.tensor(places, dtype=torch.long) for name, places in channels.items() if len(places)}
    assets = Assets(
        corpus=facts.dataset,
        synthetic=False,
        unit=facts.unit,
        frame_rate=facts.frame_rate,
        identities=facts.identities,
        templates=facts.templates,
        faces=triangles,
        regions=indices,
        space=facts.space,
    )
    if options.mesh is not None and facts.space.kind == "flame":
        from facediff.data.batch import Rig
        from facediff.mesh.flame import Flame
        from facediff.spaces.rigs import flame_rig

        rig = flame_rig(Flame.read(Path(options.mesh)), jaw=True)
        return replace(assets, rig=Rig.of(rig, assets))
    if options.mesh is not None and not facts.space.is_vertices:
        raise OptionError.naming(f"{{mesh}}: {facts.dataset} animates channels without a mesh; omit it")
    return assets


def read_triangles(mesh: Path | None, points: int) -> Tensor | None:
    """The triangles of a mesh, if there is one."""
    from facediff.mesh import read_mesh

    if mesh is None:
        return None
    drawn = read_mesh(Path(mesh))
    if len(drawn.vertices) != points:
        raise OptionError.naming(f"{{mesh}} {mesh}: has {len(drawn.vertices)} vertices, the checkpoint {points}")
    return torch.as_tensor(drawn.faces).long()


# Options.


def read_config(config: str | Path | Mapping[str, Any] | None) -> Mapping[str, Any] | None:
    """The configuration of an audio encoder."""
    if config is None or isinstance(config, Mapping):
        return config
    content = load_json(Path(config), name=f"--audio-config {config}", remedy="expected the config.json of the network")
    if not isinstance(content, dict):
        raise OptionError.naming(f"{{audio_config}} {config}: holds no options by name; expected config.json")
    return content


def read_value(text: object) -> object:
    """A value of the command line: a number, true, false, null, a list of such, or the text itself.

    >>> read_value("1e-7"), read_value("[1, 2]"), read_value("extend")
    (1e-07, [1, 2], 'extend')
    """
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text


def with_options(method: str, given: Mapping[str, Any], asked: Mapping[str, Any]) -> dict[str, Any]:
    """A model's options: those of the files, then those that the user gives; some are its audio encoder's."""
    own = options_of(registry.model.get(method)).keys() - {"n_vertices", "identities", "frame_rate", "space"}
    encoder = given.get("audio_encoder")
    encoders = options_of(component_class(encoder)).keys() - {"dim", "config", "source"} if encoder else set()
    options: dict[str, Any] = {}
    for name, text in {**given, **asked}.items():
        if name in own:
            options[name] = read_value(text) if name in asked else text
        elif name in encoders and encoder is not None:
            encoder = partial(encoder, **{name: read_value(text)})
        else:
            raise OptionError.naming(
                f"{{option}} {name}: {method} has no such option: {choices(name, [*own, *encoders])}"
            )
    return options if encoder is None else {**options, "audio_encoder": encoder}


# The model.


def label(model: AnimationModel, card: Card, facts: Facts) -> None:
    """Keep the data set's class with the model, and the licences of weights, data set and pretrained network.

    By the class, ``facediff test`` knows what to read; where its folder is, no checkpoint knows.
    """
    corpora: list[Any] = [entry.implementation for entry in registry.corpus]
    corpus = next((corpus for corpus in corpora if corpus.corpus_name == facts.dataset), None)
    data = corpus.corpus_licence() if corpus is not None else Licence(f"corpus {facts.dataset}")
    if corpus is not None:
        model.data_source = {"class_path": f"{corpus.__module__}.{corpus.__qualname__}"}
    weights = Licence(f"weights of {card.method}", card.licence, card.commercial, card.licence_source)
    model.provenance = {IMPORTED: card.method}
    model.licences = merged([weights], facts.licences or [data], network_licences(dict(model.hparams)))


def save_model(model: AnimationModel, path: Path) -> None:
    """Write a model as a checkpoint, in the form in which training writes one."""
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


# What differs, of files that cannot be imported.

MOST = 40
"""Tensors of one kind that are listed one by one."""


def examine(paths: Sequence[Path], options: ImportOptions) -> Iterator[str]:
    """Lines of a report on files and on what the import would make of them; an error ends it.

    Args:
        paths: as :func:`import_checkpoint` takes them.
        options: the user's, by which the import would be tried.
    """
    for path in paths:
        if path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            yield f"{path}: {path.stat().st_size} bytes, sha256 {digest}"
    try:
        found = convert(paths, options)
    except FaceDiffError as error:
        yield f"stops at: {error}"
        return
    card, difference = found.files.card, found.difference
    yield f"method: {card.method}; released: {', '.join(release['file'] for release in card.releases)}"
    for kind, names in {
        **vars(difference),
        "not needed": [f"{n} ({w})" for n, w in found.files.ignored.items()],
    }.items():
        yield from (f"{kind.replace('_', ' ')}: {name}" for name in names[:MOST])
        if len(names) > MOST:
            yield f"{kind.replace('_', ' ')}: {len(names) - MOST} more"
    yield f"{len(found.weights)} tensors: {'all fit' if difference.fits else 'they do not fit, see above'}"
