"""Checkpoints of the methods' own projects, as models of facediff.

A project's file holds tensors by name and little else. The names tell the method
(:mod:`facediff.models.published.cards`); the user gives everything else: the identities of the rows, the neutral faces,
the data set where its size is unusual. Every tensor is used, or reported as not needed. Nothing of a file is run.
"""

from __future__ import annotations

import hashlib
import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from facediff import registry
from facediff.data import Assets
from facediff.data.corpus import as_template, read_templates
from facediff.errors import FaceDiffError, OptionError, choices, damaged, refuse_idle
from facediff.hyperparameters import component_class
from facediff.metrics import Region
from facediff.models.checkpoint_content import IMPORTED
from facediff.models.published.cards import AuthorFiles, Card, Facts, cards, identities_of
from facediff.models.published.import_options import ImportOptions, read_object
from facediff.spaces.layouts import layout
from facediff.utils.hints import Range, options_of
from facediff.utils.licences import Licence, merged, network_licences
from facediff.utils.limits import FRAME_RATES
from facediff.utils.torch_files import read_authors_checkpoint

if TYPE_CHECKING:
    from facediff.models.base import AnimationModel
    from facediff.models.published.base import PublishedModel


@dataclass(frozen=True)
class Conversion:
    """A model of an author's checkpoint, and the checkpoint's weights."""

    files: AuthorFiles
    facts: Facts
    model: AnimationModel
    weights: dict[str, Tensor]


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


def import_files(paths: str | Path | Sequence[str | Path], options: ImportOptions) -> Conversion:
    """As :func:`import_checkpoint`; the report says what became of the files."""
    imported = convert(paths, options)
    model, card, expected = imported.model, imported.files.card, imported.model.state_dict()
    if parts := [
        f"{kind}: {names[0]} ({len(names)} in all)" for kind, names in differences(model, imported.weights) if names
    ]:
        raise FaceDiffError(
            f"{imported.files.source}: does not fit {card.method}: {'; '.join(parts)}. Print all by --doctor; sizes "
            f"that no tensor tells are given as --option NAME=VALUE, tensors to leave out as --option ignore=PREFIX"
        )
    model.load_state_dict(expected | {name: value.to(expected[name].dtype) for name, value in imported.weights.items()})
    model.adopt(assets_of(imported.facts, options))
    label(model.eval(), card, imported.facts)
    return imported


def differences(model: AnimationModel, weights: Mapping[str, Tensor]) -> list[tuple[str, list[str]]]:
    """The kinds of difference between a model's weights and an author's, and the tensors that differ so."""
    expected = {name: value for name, value in model.state_dict().items() if name != "geometry"}  # of training alone
    common = sorted(expected.keys() & weights.keys())
    return [
        ("missing", [f"{name} {tuple(value.shape)}" for name, value in expected.items() if name not in weights]),
        ("unexpected", [f"{name} {tuple(value.shape)}" for name, value in weights.items() if name not in expected]),
        (
            "misshapen",
            [
                f"{name} {tuple(weights[name].shape)}, expected {tuple(expected[name].shape)} {expected[name].dtype}"
                for name in common
                if weights[name].shape != expected[name].shape
                or weights[name].is_floating_point() != expected[name].is_floating_point()
            ],
        ),
        ("not finite", [name for name in common if not bool(weights[name].isfinite().all())]),
    ]


def convert(paths: str | Path | Sequence[str | Path], options: ImportOptions) -> Conversion:
    """Read files, and make the model that they ask for; its weights are not loaded yet."""
    files = read_files([Path(paths)] if isinstance(paths, str | Path) else [Path(path) for path in paths])
    card = files.card
    names = ("dataset", "identities", "templates", "regions", "mesh", "statistics", "data_root", "template_row")
    unread = {name: getattr(options, name) is not None for name in names if name not in card.reads}
    refuse_idle(f"{card.method} does not read this option, which would have no effect", **unread)
    options, unused = options.with_hparams()
    method: type[PublishedModel] = registry.model.get(card.method)
    given_options = options.all_model_options()
    for prefix in given_options.pop("ignore", []):
        files.ignore(prefix, "left out as asked")
    with damaged(files.source, "give the whole checkpoint, as its authors distribute it", RuntimeError):
        facts = method.author_facts(files, options) or facts_of(files, options, given_options)
        if card.frame_rate:
            given_options.pop("frame_rate", None)
        config = read_object("audio_config", options.audio_config)
        derived = method.read_author(files, facts, {**given_options, "audio_config": config})
        derived |= {name: value for name, value in files.sizes().items() if name not in derived}
        for prefix, why in card.ignored.items():
            files.ignore(prefix, why)
        files.check_positions(facts.frame_rate, facts.dataset)
        if card.encoders:
            derived["audio_encoder"] = files.encoder(config, method.encoder_settings())
    weights = files.renamed()
    model = method(**facts.sizes(), **with_options(card.method, derived, given_options))
    if unused:
        facts.notes.append(f"hparams: not needed, or read from the tensors: {', '.join(unused)}")
    return Conversion(files, facts, model, weights)


# Files.


def read_files(paths: Sequence[Path]) -> AuthorFiles:
    """The tensors of all files together, and the card of their method."""
    tensors: dict[str, Tensor] = {}
    arguments: dict[str, Mapping[str, Any]] = {}
    for path in paths:
        state, stated = read_authors_checkpoint(path)
        if duplicates := sorted(tensors.keys() & state.keys()):
            raise FaceDiffError(
                f"{path}: holds {duplicates[0]}, which another file holds as well; give one checkpoint, or the stages "
                f"of one method"
            )
        tensors |= state
        arguments |= dict.fromkeys(state, stated)
    source = ", ".join(map(str, paths))
    registry.model.load()
    for card in cards():
        for prefix in (*card.prefixes, ""):
            stripped = {name.removeprefix(prefix): value for name, value in tensors.items()}
            if card.fits(stripped):
                return AuthorFiles(stripped, source, card, arguments)
    nearest = max(cards(), key=lambda card: sum(name in tensors for name in card.required) / len(card.required))
    raise FaceDiffError(
        f"{source}: is of no method that can be imported: {', '.join(dict.fromkeys(card.method for card in cards()))}; "
        f"it holds {', '.join(list(tensors)[:3])} …, and {nearest.method}'s have {', '.join(nearest.required)}"
    )


# Faces and data, which no file holds.


def datasets() -> dict[str, Any]:
    """The data sets of the released checkpoints: vertices, frame rate, unit, identities in the order of the tables."""
    from facediff.data.biwi import Biwi
    from facediff.data.vocaset import Vocaset

    identities = ["2", "3", "6", "7", "9", "10", "11", "12", "13"]
    multiface = SimpleNamespace(n_vertices=6172, frame_rate=30.0, identities=identities, unit="0.122")
    return {"vocaset": Vocaset, "biwi": Biwi, "multiface": multiface}


def facts_of(files: AuthorFiles, options: ImportOptions, given_options: Mapping[str, Any]) -> Facts:
    """Data set, frame rate, identities and neutral faces: by the sizes of the tensors, or as the user says."""
    card = files.card
    count = files.size(*card.speakers) if card.speakers else 0
    rate = 0.0
    if card.frame_rate:
        rate = Range(*FRAME_RATES).read("frame_rate", str(given_options.get("frame_rate", card.frame_rate)))
    if card.layout:
        space = layout(card.layout)
        names = identities_of(options.identities, count, [str(number) for number in range(max(1, count))])
        return Facts(card.method, rate, names, dict.fromkeys(names, torch.zeros(len(space.channels), 1)), space)
    data_sets, points = datasets(), files.size(*card.coordinates) // 3
    by_size = next((name for name, data in data_sets.items() if data.n_vertices == points), None)
    dataset = options.dataset or by_size
    if dataset is None or dataset not in data_sets or by_size not in (None, dataset):
        raise OptionError.naming(
            f"{{dataset}}: {files.source} has {points} vertices, as has {by_size or 'no known data set'}; give the "
            f"data set that it was trained on, {'|'.join(data_sets)}, which says at how many frames a second"
        )
    data = data_sets[dataset]
    names = identities_of(options.identities, count, list(data.identities))
    unit = data.unit if points == data.n_vertices else "m"
    return Facts(dataset, rate or data.frame_rate, names, templates_of(options.templates, points), unit=unit)


def templates_of(templates: Path | Mapping[str, Any] | None, points: int) -> dict[str, Tensor]:
    """The neutral faces by speaker."""
    if templates is not None and not isinstance(templates, Mapping):
        return read_templates(Path(templates), points)
    if not templates:
        raise OptionError.naming(
            "{templates}: no checkpoint holds the neutral faces; give the data set's templates.pkl, as the projects "
            "take it"
        )
    return {
        str(name): torch.from_numpy(as_template("templates", name, face, points)) for name, face in templates.items()
    }


def assets_of(facts: Facts, options: ImportOptions) -> Assets:
    """Faces and regions; notes say which of them were not given."""
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
        if options.mesh is None:
            facts.notes.append("no --mesh: its faces have no triangles, so they can be written but not drawn")
        else:
            from facediff.mesh import read_mesh

            face = read_mesh(Path(options.mesh))
            if len(face.vertices) != points:
                raise OptionError.naming(
                    f"{{mesh}} {options.mesh}: has {len(face.vertices)} vertices, the checkpoint {points}"
                )
            triangles = torch.as_tensor(face.faces).long()
    else:
        for name in tuple(indices):
            if channels := facts.space.region(name):
                indices[name] = torch.tensor(channels, dtype=torch.long)
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
        facts.notes.append("--mesh has no effect: channels without a mesh are animated")
    return assets


# Options.


def read_value(text: object) -> object:
    """A value of the command line: a number, true, false, null, a list of such, or the text itself.

    >>> read_value("1e-7"), read_value("[1, 2]"), read_value("extend")
    (1e-07, [1, 2], 'extend')
    """
    try:
        return json.loads(text) if isinstance(text, str) else text
    except ValueError:
        return text


def with_options(method: str, derived: Mapping[str, Any], given_options: Mapping[str, Any]) -> dict[str, Any]:
    """A model's options: from the files, then from the user; some are its audio encoder's."""
    accepted = options_of(registry.model.get(method)).keys() - {"n_vertices", "identities", "frame_rate", "space"}
    encoder = derived.get("audio_encoder")
    encoders = options_of(component_class(encoder)).keys() - {"dim", "config", "source"} if encoder else set()
    options: dict[str, Any] = {}
    for name, text in {**derived, **given_options}.items():
        if name in accepted:
            options[name] = read_value(text) if name in given_options else text
        elif name in encoders and encoder is not None:
            encoder = partial(encoder, **{name: read_value(text)})
        else:
            raise OptionError.naming(
                f"{{option}} {name}: {method} has no such option: {choices(name, [*accepted, *encoders])}"
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
        )
    finally:
        announcements.setLevel(level)
    trainer.strategy.connect(model)
    with atomic(path) as temporary:
        trainer.save_checkpoint(temporary, weights_only=True)


# A report on files that cannot be imported.

MOST = 40
"""Tensors of one kind that are listed one by one."""


def examine(paths: Sequence[Path], options: ImportOptions) -> Iterator[str]:
    """Lines of a report on files and on their import; an error ends it."""
    for path in paths:
        if path.is_file():
            with path.open("rb") as stream:
                digest = hashlib.file_digest(stream, "sha256").hexdigest()
            yield f"{path}: {path.stat().st_size} bytes, sha256 {digest}"
    try:
        conversion = convert(paths, options)
    except FaceDiffError as error:
        yield f"stops at: {error}"
        return
    kinds, ignored = differences(conversion.model, conversion.weights), conversion.files.ignored
    fit = "they do not fit, see above" if any(names for _, names in kinds) else "all fit"
    card = conversion.files.card
    yield f"method: {card.method}; released: {', '.join(release['file'] for release in card.releases)}"
    for kind, names in [*kinds, ("not needed", [f"{name} ({why})" for name, why in ignored.items()])]:
        yield from (f"{kind}: {name}" for name in names[:MOST])
        if len(names) > MOST:
            yield f"{kind}: {len(names) - MOST} more"
    yield f"{len(conversion.weights)} tensors: {fit}"
