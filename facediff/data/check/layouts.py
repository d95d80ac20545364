"""Recognising a folder: a corpus, a person's folder, or neither."""

from __future__ import annotations

import importlib
import inspect
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, cast, get_args, get_origin, get_type_hints

from facediff.data.check.findings import few
from facediff.data.manifest import read_manifest, refuse_interrupted
from facediff.data.storage import MOTION_FOLDERS, WEIGHTS_FOLDER, rig_path
from facediff.errors import FaceDiffError, choices, lacking, number
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.paths import name_of_file

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule

    Module = type[SpeechMotionDataModule]
    from facediff.data.corpus import Circulating, Clip
    from facediff.data.packed.reader import PackedCorpus

MANIFEST = "manifest.json"
PROBED = 8  # files of motion whose header is read to find the topology


@dataclass(frozen=True)
class CorpusFolder:
    """Files of clips by name, and the vertex count of most of the first few readable files of motion."""

    root: Path
    motions: dict[str, Path]
    sounds: dict[str, Path]
    n_vertices: int | None
    source: Path | str  # of the motion: the folder, or the packed corpus

    @property
    def names(self) -> list[str]:
        """Names of all clips that have at least one file, sorted."""
        return sorted({*self.motions, *self.sounds})


@dataclass(frozen=True)
class CorpusView:
    """The properties of a corpus that the check needs, from its data module or the manifest of a person's folder."""

    corpus: str
    data_module: str | None  # import path; None for a person's folder
    n_vertices: int
    frame_rate: float  # motion frames a second that models see
    stored_frame_rate: float  # those on disk where manifest.json has none
    parse: Callable[[str], Clip | None]  # subject and sentence by a clip's name; None if that is none of the corpus
    split_of: dict[str | None, Callable[[Clip], str | None]]  # for each of the ways in which the corpus is split
    identities: list[str] = field(default_factory=list)  # speakers who are trained on
    expected: dict[str, list[str]] = field(default_factory=dict)  # clips of a complete corpus by split, where known
    mesh_files: tuple[str, ...] = ()
    region_sources: dict[str, tuple[str, ...]] = field(default_factory=dict)
    region_help: str = ""  # where the files of the regions can be obtained
    obtain: str = ""  # how the corpus can be obtained
    unit: str = ""  # of length, where manifest.json has none
    circulating: Circulating | None = None  # facts about the copies that circulate


def identify(folder: CorpusFolder, manifest: dict[str, Any], corpus: str | None) -> CorpusView:
    """The corpus of a folder: by the name or import path of its data module, or found out if None."""
    if corpus is None and manifest.get("person"):
        return _view_of_person(manifest, folder.n_vertices)
    recorded = manifest.get("corpus")
    module = recognise(folder, recorded) if corpus is None else by_name(corpus, folder.n_vertices)
    if module is not None:
        return _view_of_module(module, folder.source)
    contents = "there is no wav/*.wav or vertices_npy/*.npy"
    if folder.names:
        vertices = "unreadable motion" if folder.n_vertices is None else f"{number(folder.n_vertices)} vertices"
        contents = f"there are clips {few(folder.names)} with {vertices}"
    raise FaceDiffError(
        f"{folder.root}: not recognised: {contents}, and {MANIFEST} names no known corpus. Give the right folder, name "
        f"the corpus with --corpus, or run `facediff data prepare` if this is a raw distribution"
    )


def view_of(root: Path, corpus: str | None) -> CorpusView:
    """Recognise a corpus folder; see :func:`identify`."""
    refuse_interrupted(root)
    return identify(list_folder(root), read_manifest(root), corpus)


# The files of the folder.


def list_folder(root: Path) -> CorpusFolder:
    """List the files of clips in a corpus folder; pipes, which would be waited for, are none."""
    found: list[dict[str, Path]] = []
    for folders, suffix in (((*MOTION_FOLDERS, WEIGHTS_FOLDER), "npy"), (("wav",), "wav")):
        paths = [path for folder in folders for path in sorted((root / folder).glob(f"[!.]*.{suffix}"))]
        # Of several folders the first has the preference.
        found.append({name_of_file(path): path for path in reversed(paths) if path.is_file()})
    motions, sounds = found
    counts: Counter[int] = Counter()
    for name in sorted(motions)[:PROBED]:
        with suppress(Exception):  # reported when the clips are checked
            counts[vertices_of(open_array(rig_path(motions[name]) or motions[name]).shape) or 0] += 1
    return CorpusFolder(root, motions, sounds, counts.most_common(1)[0][0] or None if counts else None, root)


def list_packed(packed: PackedCorpus) -> CorpusFolder:
    """The clips of a packed corpus, named as the files that they would be."""
    motions = {name: Path(f"vertices_npy/{name}.npy") for name in packed.names()}
    return CorpusFolder(packed.folder, motions, motions, packed.record.n_vertices, packed.source)


# The data module that reads it.


def by_name(name: str, n_vertices: int | None, option: str = "--corpus") -> Module:
    """The data module of a corpus name (``biwi``), a class name (``Biwi``) or an import path (``package.Class``).

    The vertices found in the folder decide between several modules of one corpus; errors name the option.
    """
    if "." in name:
        return _import(name, option)
    fitting = [m for m in _known() if name.lower() in (m.corpus_name.lower(), m.__name__.lower())]
    if not fitting:
        names = dict.fromkeys(module.corpus_name for module in _known())
        raise FaceDiffError(
            f'{option}: there is no "{name}": {choices(name, names)}; a data module of your own is given by its import '
            f"path, package.module.Class"
        )
    return next((module for module in fitting if module.n_vertices == n_vertices), fitting[0])


def recognise(folder: CorpusFolder, recorded: str | None) -> Module | None:
    """The data module that ``manifest.json`` names, else the one of these vertices that names most clips."""
    modules = _known()
    fitting = [m for m in modules if recorded and m.corpus_name in (recorded, recorded.removeprefix("facediff-"))]
    if fitting:
        return next((module for module in fitting if module.n_vertices == folder.n_vertices), fitting[0])
    fitting = [module for module in modules if module.n_vertices == folder.n_vertices]
    counts = {module: sum(module.parse_name(name) is not None for name in folder.names) for module in fitting}
    return max(fitting, key=lambda module: counts[module]) if any(counts.values()) else None


def _known() -> list[Module]:
    """Every data module of vertices that can be instantiated and names its corpus, facediff's own first."""
    from facediff import registry
    from facediff.data import SpeechMotionDataModule

    registry.corpus.load()  # a data module is a subclass only once it is imported

    def below(module: Any) -> Iterator[Module]:  # noqa: ANN401 - an abstract class is no Module to mypy
        for child in module.__subclasses__():
            yield child
            yield from below(child)

    modules = dict.fromkeys(below(SpeechMotionDataModule))
    concrete = [m for m in modules if not inspect.isabstract(m) and getattr(m, "corpus_name", None)]
    return sorted(
        (m for m in concrete if m.space.is_vertices), key=lambda module: not module.__module__.startswith("facediff.")
    )


def _import(path: str, option: str) -> Module:
    from facediff.data import SpeechMotionDataModule

    package, _, name = path.rpartition(".")
    try:
        module = getattr(importlib.import_module(package), name)
        fault = lacking(module) if issubclass(module, SpeechMotionDataModule) else "is no data module"
    except Exception as error:  # a module can fail in any way while it is imported
        fault = f"cannot be imported ({error})"
    if fault:
        raise FaceDiffError(f"{option} {path}: {fault}; expected package.module.Class of a data module")
    return cast("Module", module)


# The properties that the check needs.


def _view_of_module(module: Module, root: Path | str) -> CorpusView:
    hint: Any = get_type_hints(module.__init__).get("split")
    ways: list[str | None] = list(get_args(hint)) if get_origin(hint) is Literal else [None]
    modules = {way: instance(module, root, way) for way in ways}
    first = modules[ways[0]]
    names = ("mesh_files", "region_sources", "region_help", "obtain", "unit", "circulating")
    return CorpusView(
        corpus=module.corpus_name,
        data_module=f"{module.__module__}.{module.__qualname__}",
        n_vertices=first.n_vertices,
        frame_rate=first.frame_rate,
        stored_frame_rate=module.stored_frame_rate or first.frame_rate,
        parse=module.parse_name,
        split_of={way: data.split_of for way, data in modules.items()},
        identities=list(first.identities),
        expected=module.expected_clips(),
        **{name: getattr(module, name) for name in names},
    )


def instance(module: Module, root: Path | str, way: str | None) -> SpeechMotionDataModule:
    """The data module of a folder, for one of the ways in which the corpus is split."""
    options: dict[str, Any] = {} if way is None else {"split": way}
    return module(root=str(root), **options)


def _view_of_person(manifest: dict[str, Any], n_vertices: int | None) -> CorpusView:
    """A person's folder, as ``facediff data import-person`` writes it, through its own ``manifest.json``."""
    from facediff.data.corpus import parse_name

    rate, vertices = manifest.get("frame_rate"), manifest.get("n_vertices", n_vertices)
    if not rate or not vertices:
        raise FaceDiffError(f"lacks the frame rate or the vertices of {manifest['person']}; import the person again")
    return CorpusView(
        corpus="person",
        data_module=None,
        n_vertices=vertices,
        frame_rate=rate,
        stored_frame_rate=rate,
        parse=parse_name,
        split_of={
            None: lambda clip: {"test": "test_a"}.get(clip.attributes.get("split", ""), clip.attributes.get("split"))
        },
        identities=[manifest["person"]],
    )
