"""Recognising a folder: a corpus, a person's folder, a raw distribution, or none of these."""

from __future__ import annotations

import importlib
import inspect
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, get_args, get_origin, get_type_hints

from facediff.data.check.report import CheckReport, Findings, few
from facediff.data.manifest import load_manifest
from facediff.data.storage import WEIGHTS_FOLDER, rig_path
from facediff.errors import FaceDiffError, choices, lacking, number
from facediff.utils.arrays import open_array, vertices_of

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule

    Module = type[SpeechMotionDataModule]
    from facediff.data.corpus import Clip
    from facediff.data.packed.reader import PackedCorpus

MANIFEST = "manifest.json"
STATE = "prepare.json"
"""In the folder while preparation is running or was interrupted."""
SPLITS = ("train", "val", "test_a", "test_b", "test_c")

PROBED = 8  # files of motion whose header is read to find the topology
HALF = 0.5  # share of the names that must be of a corpus's form to recognise it
FACEXHUBERT = re.compile(r"[FM]\d_(\d\d)(_cut)?")
"""BIWI's clips in FaceXHuBERT's preparation: NN for a neutral sequence, NN + 40 for an emotional one."""

RAW_FILES = {
    "biwi": ("faces/*/*/frame_*.vl",),
    "vocaset": ("data_verts.npy", "subj_seq_to_idx.pkl"),
    "mead3d": (
        "*/front/*/*/*/shape_pose_cam.hdf5",
        "*/*/front/*/*/*/shape_pose_cam.hdf5",
        "param/*.npy",
        "mead/param/*.npy",
        "datasets/mead/param/*.npy",
    ),
}
"""Files of raw distributions, by their name in ``facediff data prepare``."""
BASES = 100  # folders in the raw folder that are searched: an archive may have been unpacked to one of them


@dataclass(frozen=True)
class CorpusFolder:
    """Files of clips by name, files that a killed program left half-written, and files of other types."""

    root: Path
    motions: dict[str, Path] = field(default_factory=dict)
    sounds: dict[str, Path] = field(default_factory=dict)
    leftovers: list[str] = field(default_factory=list)
    strays: list[str] = field(default_factory=list)
    packed: PackedCorpus | None = None  # what the clips lie in, if they are no files

    @property
    def names(self) -> list[str]:
        """Names of all clips that have at least one file, sorted."""
        return sorted({*self.motions, *self.sounds})

    def n_vertices(self) -> int | None:
        """The vertex count of most of the first few readable files of motion; None if there is none."""
        if self.packed is not None:
            return self.packed.record.n_vertices
        counts: Counter[int] = Counter()
        for path in islice(self.motions.values(), PROBED):
            try:
                vertices = vertices_of(open_array(rig_path(path) or path).shape)
            except Exception:  # reported when the clips are checked
                vertices = None
            if vertices is not None:
                counts[vertices] += 1
        return counts.most_common(1)[0][0] if counts else None


@dataclass(frozen=True)
class CorpusView:
    """The facts about a corpus that the check needs, from its data module or from a person's own folder."""

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


def identify(
    report: CheckReport,
    folder: CorpusFolder,
    recorded: object,
    corpus: str | None,
    split: str | None,
    manifest: dict[str, Any],
) -> CorpusView | None:
    """The corpus that a folder holds; None, with a finding, if it holds none or is not recognised.

    ``recorded`` is the corpus that ``manifest.json`` or ``prepare.json`` names, ``corpus`` the one that the user names,
    ``split`` the only one of the ways in which the corpus is split that is wanted.
    """
    root, n_vertices, findings = folder.root, folder.n_vertices(), report.findings
    module = None if corpus is None else by_name(corpus, n_vertices)
    if not folder.motions and (raw := _raw_distribution(root)) is not None:
        report.raw, file = raw
        command = f"facediff data prepare {report.raw} {root} OUT" + (" --flame MODEL" * (report.raw == "mead3d"))
        message = f"this is the raw distribution of {report.raw} and not yet a corpus: run `{command}`"
        findings.error("raw", file, message)
        return None
    if module is None and isinstance(manifest.get("person"), str):
        view: CorpusView | None = None
        with findings.guard("manifest_unreadable", root / MANIFEST, root):
            view = _view_of_person(manifest, n_vertices)
        return view
    module = module or recognise(folder, recorded, n_vertices)
    if module is not None:
        return _view_of_module(module, root, split)
    reasons = [
        f"no {MANIFEST} names a corpus"
        if recorded is None
        else f"{MANIFEST} names {recorded!r}, which no data module reads"
    ]
    if folder.names:
        vertices = "unreadable motion" if n_vertices is None else f"{number(n_vertices)} vertices"
        corpora = dict.fromkeys(module.corpus_name for module in _known())
        reasons.append(f"there are clips {few(folder.names)} with {vertices}, which fit none of {few(corpora)}")
    else:
        patterns = ", ".join(pattern for patterns in RAW_FILES.values() for pattern in patterns)
        reasons.append(f"there is no wav/*.wav or vertices_npy/*.npy, and nothing of a raw distribution ({patterns})")
    message = f"not recognised: {'; '.join(reasons)}. Give the right folder, or name the corpus with --corpus"
    findings.error("unrecognised", str(root), message)
    return None


def view_of(root: Path, corpus: str | None) -> CorpusView:
    """Recognise a corpus folder.

    Args:
        root: the folder.
        corpus: name or import path of its data module; found out if None.
    """
    from facediff.data.corpus import MOTION_FOLDERS
    from facediff.data.manifest import read_manifest

    if not root.is_dir():
        raise FaceDiffError(f"{root}: no such folder; expected a corpus with wav/, vertices_npy/ and templates.pkl")
    if (root / STATE).is_file() and not (root / MANIFEST).is_file():
        raise FaceDiffError(f"{root}: its preparation was interrupted; run the same `facediff data prepare` again")
    manifest, report = read_manifest(root), CheckReport(root)
    view = identify(report, list_folder(root, MOTION_FOLDERS), manifest.get("corpus"), corpus, None, manifest)
    if view is None:
        raise FaceDiffError(f"{root}: {report.findings[0].message}")
    return view


# The files of the folder.


def list_folder(root: Path, motion_folders: tuple[str, ...]) -> CorpusFolder:
    """List the files of clips in a corpus folder; ``motion_folders`` are in the order of preference."""
    folder = CorpusFolder(root)
    motions = [(name, ".npy", folder.motions) for name in (*motion_folders, WEIGHTS_FOLDER)]
    for name, suffix, files in [*motions, ("wav", ".wav", folder.sounds)]:
        try:
            paths = sorted(root / name / file for file in os.listdir(root / name))
        except (FileNotFoundError, NotADirectoryError):
            continue
        except OSError as error:
            raise FaceDiffError(f"{root / name}: cannot be read ({error.strerror}); check its permissions") from error
        for path in paths:
            if path.name.startswith("."):
                if ".partial-" in path.name:
                    folder.leftovers.append(f"{name}/{path.name}")
            elif path.suffix == suffix:
                files.setdefault(path.stem, path)
            else:
                folder.strays.append(f"{name}/{path.name}")
    return folder


def list_packed(packed: PackedCorpus) -> CorpusFolder:
    """The clips of a packed corpus, named as the files that they would be."""
    motions = {name: Path(f"vertices_npy/{name}.npy") for name in packed.names()}
    sounds = {name: Path(f"wav/{name}.wav") for name in packed.names()}
    return CorpusFolder(packed.folder, motions, sounds, packed=packed)


def read_record(root: Path, name: str, findings: Findings) -> dict[str, Any]:
    """``manifest.json`` or ``prepare.json``; empty if it is missing or cannot be read."""
    path = root / name
    if path.is_file():
        with findings.guard("manifest_unreadable", path, root):
            return load_manifest(path)
    return {}


def _raw_distribution(root: Path) -> tuple[str, str] | None:
    """The data set whose raw distribution a folder holds, and a file that shows it; None if it holds none."""
    try:
        inner = list(islice((path for path in sorted(root.iterdir()) if path.is_dir()), BASES))
    except OSError:
        inner = []
    for base in [root, *inner]:
        for corpus, patterns in RAW_FILES.items():
            for pattern in patterns:
                with suppress(OSError):
                    for file in base.glob(pattern):
                        return corpus, file.relative_to(root).as_posix()
    return None


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


def recognise(folder: CorpusFolder, recorded: object, n_vertices: int | None) -> Module | None:
    """The data module that reads a folder; None if that cannot be found out.

    ``manifest.json`` decides; else most of the clips' names together with the vertex count; else names of a form of
    their own (so that wrong vertices are reported as such); else a vertex count that only one corpus has.
    """
    modules = _known()
    if isinstance(recorded, str):
        named = [m for m in modules if m.corpus_name in (recorded, recorded.removeprefix("facediff-"))]
        if named:
            return next((module for module in named if module.n_vertices == n_vertices), named[0])
    fitting = [module for module in modules if module.n_vertices == n_vertices]
    best = _most_names(fitting, folder.names) or _most_names([m for m in modules if _own_names(m)], folder.names)
    if best is not None:
        return best
    if facexhubert_names(folder.names):
        return by_name("biwi", n_vertices)
    return fitting[0] if len({module.corpus_name for module in fitting}) == 1 else None


def facexhubert_names(names: Sequence[str]) -> list[str]:
    """Names as FaceXHuBERT forms them, if numbers above 40, which stand for emotional sequences, are among them."""
    numbers = {name: int(match[1]) for name in names if (match := FACEXHUBERT.fullmatch(name))}
    return list(numbers) if any(number > 40 for number in numbers.values()) else []


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
    named = [m for m in modules if not inspect.isabstract(m) and getattr(m, "corpus_name", None)]
    concrete = [m for m in named if m.space.is_vertices]
    return sorted(concrete, key=lambda module: not module.__module__.startswith("facediff."))


def _import(path: str, option: str) -> Module:
    from facediff.data import SpeechMotionDataModule

    place, _, name = path.rpartition(".")
    try:
        module = getattr(importlib.import_module(place), name)
    except Exception as error:  # a module can fail in any way while it is imported
        raise FaceDiffError(f"{option} {path}: cannot be imported ({error}); expected package.module.Class") from error
    if not (isinstance(module, type) and issubclass(module, SpeechMotionDataModule)):
        raise FaceDiffError(f"{option} {path}: is no data module; expected a subclass of SpeechMotionDataModule")
    if fault := lacking(module):
        raise FaceDiffError(f"{option} {path}: {fault}")
    return module


def _most_names(modules: Sequence[Module], names: Sequence[str]) -> Module | None:
    """The data module that parses most of the names, and at least half of them."""

    def knows(module: Module, name: str) -> bool:
        clip = module.parse_name(name)
        return clip is not None and (_own_names(module) or clip.identity in module.identities)

    scores = {module: sum(knows(module, name) for name in names) for module in modules}
    best = max(scores, key=lambda module: scores[module], default=None)
    return best if best is not None and scores[best] and scores[best] >= HALF * len(names) else None


def _own_names(module: Module) -> bool:
    """Whether a data module has a form of names of its own."""
    from facediff.data import SpeechMotionDataModule

    return module.parse_name.__func__ is not SpeechMotionDataModule.parse_name.__func__  # type: ignore[attr-defined]


# The facts that the check needs.


def _view_of_module(module: Module, root: Path, split: str | None) -> CorpusView:
    parameter = inspect.signature(module).parameters.get("split")
    hint: Any = None if parameter is None else get_type_hints(module.__init__).get("split")
    ways: list[str | None] = list(get_args(hint)) if get_origin(hint) is Literal else [None]
    if split is not None and split not in ways:
        names = [way for way in ways if way is not None]
        raise FaceDiffError(
            f'--split: {module.corpus_name} has no split "{split}": {choices(split, names)}'
            if names
            else f"--split: {module.corpus_name} is split in one way only; omit the option"
        )
    ways = ways if split is None else [split]
    modules = {way: instance(module, root, way) for way in ways}
    first = modules[ways[0]]
    return CorpusView(
        corpus=module.corpus_name,
        data_module=f"{module.__module__}.{module.__qualname__}",
        n_vertices=first.n_vertices,
        frame_rate=module.frame_rate,
        stored_frame_rate=module.stored_frame_rate or module.frame_rate,
        parse=module.parse_name,
        split_of={way: data.split_of for way, data in modules.items()},
        identities=list(first.identities),
        expected=module.expected_clips(),
        mesh_files=module.mesh_files,
        region_sources=dict(module.region_sources),
        region_help=module.region_help,
        obtain=module.obtain,
        unit=module.unit,
    )


def instance(module: Module, root: Path, way: str | None) -> SpeechMotionDataModule:
    """The data module of a folder, for one of the ways in which the corpus is split."""
    options: dict[str, Any] = {} if way is None else {"split": way}
    try:
        return module(root=str(root), **options)
    except TypeError as error:
        raise FaceDiffError(
            f"--corpus {module.__name__}: cannot be instantiated from a folder alone ({error}); give the other "
            f"parameters defaults"
        ) from error


def is_rate(value: object) -> TypeGuard[float]:
    """Whether a value of a manifest can be a frame rate."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value <= 10_000


def _view_of_person(manifest: dict[str, Any], n_vertices: int | None) -> CorpusView:
    """A person's folder, as ``facediff data import-person`` writes it, through its own ``manifest.json``."""
    from facediff.data.corpus import parse_name

    person, rate, vertices = manifest["person"], manifest.get("frame_rate"), manifest.get("n_vertices", n_vertices)
    if not (is_rate(rate) and isinstance(vertices, int) and vertices > 0):
        raise FaceDiffError(f"lacks the frame rate or the vertices of {person}; import the person again")

    def split(clip: Clip) -> str | None:
        recorded = clip.attributes.get("split")
        return "test_a" if recorded == "test" else recorded

    return CorpusView(
        corpus="person",
        data_module=None,
        n_vertices=vertices,
        frame_rate=rate,
        stored_frame_rate=rate,
        parse=parse_name,
        split_of={None: split},
        identities=[person],
    )
