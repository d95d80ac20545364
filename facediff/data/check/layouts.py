"""What a folder is: a corpus, a person's folder, a raw distribution, or nothing that is known."""

from __future__ import annotations

import importlib
import inspect
import json
import os
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypeGuard, get_args, get_origin, get_type_hints

from facediff.data.check.findings import Finding, Report, counted, few, guarded, number
from facediff.errors import FaceDiffError, choices
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.files import sha256

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule

    Module = type[SpeechMotionDataModule]
    from facediff.data.corpus import Clip, Corpus


# Looking at what ``facediff data prepare`` has recorded, and whether the files are still those.

MANIFEST = "manifest.json"
STATE = "prepare.json"
"""There while preparing is at work or was cut short."""


def read_record(root: Path, name: str, findings: list[Finding]) -> dict[str, Any]:
    """One of the two records; empty if there is none, or none that can be read."""
    path = root / name
    if path.is_file():
        with guarded(findings, "manifest_unreadable", path, root):
            try:
                record = json.loads(path.read_bytes())
            except (ValueError, RecursionError) as error:
                raise FaceDiffError(
                    f"not readable as JSON ({error}); prepare the folder anew, or remove the file"
                ) from error
            if not isinstance(record, dict):
                raise FaceDiffError("holds no JSON object; prepare the folder anew, or remove the file")
            return record
    return {}


def check_ended(root: Path, corpus: str | None, findings: list[Finding]) -> bool:
    """Whether preparing has ended, where it was begun at all."""
    if not (root / STATE).exists():
        return True
    findings.append(
        Finding(
            "error",
            "unfinished",
            STATE,
            f"preparing this folder has not ended: run the same `facediff data prepare {corpus or 'CORPUS'} RAW "
            f"{root}` again (it goes on where it was), or wait if it is at work",
        )
    )
    return False


def check_files(
    root: Path, manifest: Mapping[str, Any], hashes: Mapping[str, str], findings: list[Finding], *, quick: bool
) -> dict[str, list[str]]:
    """Hold the files against their sizes (``quick``), or their SHA-256, in ``manifest.json``.

    Args:
        root: the corpus folder.
        manifest: what it says.
        hashes: SHA-256 of the files that were read already.
        findings: what is wrong is added here.
        quick: compare sizes only.

    Returns:
        the names of the files that are not as recorded: ``changed`` and ``missing``.
    """
    files = manifest.get("files")
    found: dict[str, list[str]] = {"changed": [], "missing": []}
    if not isinstance(files, dict):
        return found
    for name, said in files.items():
        path = root / name
        if not isinstance(said, dict) or not _is_below(root, path):
            message = f'"{name}" is no entry of a file below the folder; prepare the folder anew'
            findings.append(Finding("error", "manifest_entry", MANIFEST, message))
            continue
        with guarded(findings, "file_unreadable", path, root):
            if not path.is_file():
                found["missing"].append(name)
                message = "is in manifest.json and is not there; prepare the folder anew"
                findings.append(Finding("error", "file_missing", name, message))
            elif not _is_as_recorded(path, said, hashes.get(name), quick=quick):
                found["changed"].append(name)
                message = "is not what was written (manifest.json): changed since, or damaged; prepare the folder anew"
                findings.append(Finding("error", "file_changed", name, message))
    return found


def _is_as_recorded(path: Path, said: Mapping[str, Any], known: str | None, *, quick: bool) -> bool:
    if path.stat().st_size != said.get("bytes"):
        return False
    return quick or (known or sha256(path)) == said.get("sha256")


def _is_below(root: Path, path: Path) -> bool:
    """Whether a name from the record stays in the folder: nothing else is opened on a stranger's word."""
    try:
        return path.resolve().is_relative_to(root.resolve())
    except (OSError, ValueError, RuntimeError):
        return False


def check_account(manifest: Mapping[str, Any], findings: list[Finding]) -> None:
    """Tell what preparing itself has reported: clips that failed, and what the raw folder did not have."""
    failed, missing = manifest.get("failed"), manifest.get("missing")
    if isinstance(failed, dict) and failed:
        name, reason = next(iter(failed.items()))
        message = f"{counted(len(failed), 'clip')} could not be prepared, the first: {name}: {reason}"
        findings.append(Finding("warning", "prepare_failed", MANIFEST, message))
    if isinstance(missing, dict) and missing:
        message = f"the raw folder had not everything: {few(missing)}; the reasons are in {MANIFEST}"
        findings.append(Finding("note", "prepare_missing", MANIFEST, message))


# What lies in a corpus folder, by name only.

PROBED = 8
"""Files of motion whose header is looked at to tell the topology."""


@dataclass(frozen=True)
class Folder:
    """Files of clips.

    Attributes:
        root: the corpus folder.
        motions: files of motion by clip name.
        sounds: files of speech by clip name.
        leftovers: files that a killed program left half-written.
        strays: other files among the clips, which nobody reads.
    """

    root: Path
    motions: dict[str, Path] = field(default_factory=dict)
    sounds: dict[str, Path] = field(default_factory=dict)
    leftovers: list[str] = field(default_factory=list)
    strays: list[str] = field(default_factory=list)

    @property
    def names(self) -> list[str]:
        """Names of all clips that have at least one file, sorted."""
        return sorted({*self.motions, *self.sounds})

    def n_vertices(self) -> int | None:
        """The vertex count of most of the first few readable files of motion; None if there is none."""
        counts: Counter[int] = Counter()
        for path in islice(self.motions.values(), PROBED):
            try:
                found = vertices_of(open_array(path).shape)
            except Exception:  # told when the clips are looked at
                found = None
            if found is not None:
                counts[found] += 1
        return counts.most_common(1)[0][0] if counts else None


def list_folder(root: Path, motion_folders: tuple[str, ...]) -> Folder:
    """List the files of clips in a corpus folder.

    Args:
        root: the folder.
        motion_folders: where motion may lie, in the order of preference.

    Raises:
        FaceDiffError: if the folder cannot be read.
    """
    folder = Folder(root)
    for name, suffix, files in [
        *((name, ".npy", folder.motions) for name in motion_folders),
        ("wav", ".wav", folder.sounds),
    ]:
        for path in _entries(root / name):
            if path.name.startswith("."):
                if ".partial-" in path.name:
                    folder.leftovers.append(f"{name}/{path.name}")
            elif path.suffix == suffix:
                files.setdefault(path.stem, path)
            else:
                folder.strays.append(f"{name}/{path.name}")
    return folder


def _entries(folder: Path) -> list[Path]:
    try:
        return sorted(folder / name for name in os.listdir(folder))
    except (FileNotFoundError, NotADirectoryError):
        return []
    except OSError as error:
        raise FaceDiffError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from error


# Which corpus a folder is: the data modules that are known, and how they are told apart.

HALF = 0.5
"""Share of the names that a corpus must know to be recognised by them."""

FACEXHUBERT = re.compile(r"[FM]\d_(\d\d)(_cut)?")
"""BIWI's clips in FaceXHuBERT's preparation: NN for a neutral sequence, NN + 40 for an emotional one."""


def known() -> list[Module]:
    """Every data module that can be made, facediff's own first."""
    from facediff import registry
    from facediff.data import SpeechMotionDataModule

    registry.corpus.load()  # a data module is a subclass only once it is imported

    def below(module: Any) -> Iterator[Module]:  # noqa: ANN401 - an abstract class is no Module to mypy
        for child in module.__subclasses__():
            yield child
            yield from below(child)

    found = [m for m in dict.fromkeys(below(SpeechMotionDataModule)) if not inspect.isabstract(m) and named(m)]
    return sorted(found, key=lambda module: not module.__module__.startswith("facediff."))


def named(module: Module) -> str | None:
    """Name of the corpus that a data module reads; None if it does not say."""
    return getattr(module, "corpus_name", None)


def by_name(name: str, n_vertices: int | None) -> Module:
    """The data module of a corpus name (``biwi``), a class name (``Biwi``) or an import path (``package.Class``).

    Args:
        name: what was asked for.
        n_vertices: vertices found in the folder; decides between several modules of one corpus.

    Raises:
        FaceDiffError: naming the known corpora.
    """
    if "." in name:
        return _import(name)
    wanted = [m for m in known() if name.lower() in (str(named(m)).lower(), m.__name__.lower())]
    if not wanted:
        names = dict.fromkeys(str(named(module)) for module in known())
        raise FaceDiffError(
            f'--corpus: there is no "{name}": {choices(name, names)}; a data module of your own is given by its import '
            f"path, package.module.Class"
        )
    return next((module for module in wanted if module.n_vertices == n_vertices), wanted[0])


def _import(path: str) -> Module:
    from facediff.data import SpeechMotionDataModule

    place, _, name = path.rpartition(".")
    try:
        module = getattr(importlib.import_module(place), name)
    except Exception as error:  # a module can fail in any way while it is imported
        raise FaceDiffError(f"--corpus {path}: cannot be imported ({error}); expected package.module.Class") from error
    if not (isinstance(module, type) and issubclass(module, SpeechMotionDataModule)) or inspect.isabstract(module):
        raise FaceDiffError(f"--corpus {path}: is no data module; expected a subclass of SpeechMotionDataModule")
    return module


def recognise(folder: Folder, said: object, n_vertices: int | None) -> Module | None:
    """The data module that a folder is for; None if that cannot be told.

    What ``manifest.json`` says decides; else most of the clips' names together with the vertex count; else names of a
    form of their own (so that wrong vertices are told as such); else a vertex count that only one corpus has.

    Args:
        folder: the folder.
        said: the corpus that ``manifest.json`` names, if it does.
        n_vertices: vertices found in the folder.
    """
    modules = known()
    if isinstance(said, str):
        wanted = [m for m in modules if named(m) in (said, said.removeprefix("facediff-"))]
        if wanted:
            return next((module for module in wanted if module.n_vertices == n_vertices), wanted[0])
    fitting = [module for module in modules if module.n_vertices == n_vertices]
    best = _most_known(fitting, folder.names) or _most_known([m for m in modules if names_tell(m)], folder.names)
    if best is not None:
        return best
    if facexhubert_names(folder.names):
        return by_name("biwi", n_vertices)
    return fitting[0] if len({named(module) for module in fitting}) == 1 else None


def _most_known(modules: Sequence[Module], names: Sequence[str]) -> Module | None:
    scores = {module: sum(knows(module, name) for name in names) for module in modules}
    best = max(scores, key=lambda module: scores[module], default=None)
    return best if best is not None and scores[best] and scores[best] >= HALF * len(names) else None


def knows(module: Module, name: str) -> bool:
    """Whether a name is one of the corpus's, as far as its data module can tell without the folder."""
    clip = module.parse_name(name)
    return clip is not None and (names_tell(module) or clip.identity in module.identities)


def names_tell(module: Module) -> bool:
    """Whether a data module has a form of names of its own."""
    from facediff.data import SpeechMotionDataModule

    return module.parse_name.__func__ is not SpeechMotionDataModule.parse_name.__func__  # type: ignore[attr-defined]


def facexhubert_names(names: Sequence[str]) -> list[str]:
    """The names in FaceXHuBERT's manner, if numbers above 40, which stand for emotional sequences, are among them."""
    found = {name: int(match[1]) for name in names if (match := FACEXHUBERT.fullmatch(name))}
    return list(found) if any(number > 40 for number in found.values()) else []


def variants(module: Module) -> list[str | None]:
    """The ways in which a data module can be told to split its clips; a single None if there is one way only."""
    parameter = inspect.signature(module).parameters.get("split")
    hint: Any = None if parameter is None else get_type_hints(module.__init__).get("split")
    return list(get_args(hint)) if get_origin(hint) is Literal else [None]


# What the doctor needs to know about a corpus, whether a data module tells it or a person's own folder.

SPLITS = ("train", "val", "test_a", "test_b")


@dataclass(frozen=True)
class View:
    """A corpus as the doctor sees it.

    Attributes:
        corpus: its name.
        data_module: import path of the data module; None for a person's folder.
        n_vertices: vertices of its topology.
        frame_rate: motion frames a second that models see.
        stored_frame_rate: those on disk where ``manifest.json`` does not say.
        parse: tells subject and sentence from a name; None for a name that is none of the corpus.
        split_of: tells a clip's split, for each of the ways in which the corpus is split.
        identities: people who are trained on.
        expected: clips of a complete corpus by split; empty where there is no such list.
        mesh_files: files with the faces.
        region_sources: files that say which vertices the regions are.
        region_help: where such files are had.
        obtain: how the corpus is had.
    """

    corpus: str
    data_module: str | None
    n_vertices: int
    frame_rate: float
    stored_frame_rate: float
    parse: Callable[[str], Clip | None]
    split_of: dict[str | None, Callable[[Clip], str | None]]
    identities: list[str] = field(default_factory=list)
    expected: dict[str, list[str]] = field(default_factory=dict)
    mesh_files: tuple[str, ...] = ()
    region_sources: dict[str, tuple[str, ...]] = field(default_factory=dict)
    region_help: str = ""
    obtain: str = ""

    def open(self, root: Path) -> Corpus:
        """The folder as training reads it.

        Raises:
            FaceDiffError: if ``manifest.json`` says a frame rate that does not fit.
        """
        from facediff.data.corpus import Corpus

        return Corpus(
            root, self.n_vertices, self.frame_rate, stored_frame_rate=self.stored_frame_rate, parse=self.parse
        )


def view_of(module: type[SpeechMotionDataModule], root: Path, split: str | None) -> View:
    """A corpus through its data module.

    Args:
        module: the data module.
        root: the corpus folder.
        split: only this one of the ways in which the corpus is split; all if None.

    Raises:
        FaceDiffError: if the corpus is not split in this way, or the data module cannot be made.
    """
    ways = variants(module)
    if split is not None and split not in ways:
        known = [way for way in ways if way is not None]
        raise FaceDiffError(
            f'--split: {module.corpus_name} has no split "{split}": {choices(split, known)}'
            if known
            else f"--split: {module.corpus_name} is split in one way only; leave the option away"
        )
    chosen = ways if split is None else [split]
    return View(
        corpus=module.corpus_name,
        data_module=f"{module.__module__}.{module.__qualname__}",
        n_vertices=module.n_vertices,
        frame_rate=module.frame_rate,
        stored_frame_rate=module.stored_frame_rate or module.frame_rate,
        parse=module.parse_name,
        split_of={way: _instance(module, root, way).split_of for way in chosen},
        identities=list(module.identities),
        expected=module.expected_clips(),
        mesh_files=module.mesh_files,
        region_sources=dict(module.region_sources),
        region_help=module.region_help,
        obtain=module.obtain,
    )


def _instance(module: type[SpeechMotionDataModule], root: Path, way: str | None) -> SpeechMotionDataModule:
    options: dict[str, Any] = {} if way is None else {"split": way}
    try:
        return module(root=str(root), **options)
    except TypeError as error:
        raise FaceDiffError(
            f"--corpus {module.__name__}: cannot be made from a folder alone ({error}); give the rest defaults"
        ) from error


def is_rate(value: object) -> TypeGuard[float]:
    """Whether a value of a record can be a frame rate."""
    return isinstance(value, int | float) and not isinstance(value, bool) and 1 <= value <= 10_000


def view_of_person(manifest: dict[str, Any], n_vertices: int | None) -> View:
    """A person's folder, as ``facediff data import-person`` writes it, through its own ``manifest.json``.

    Args:
        manifest: what it says.
        n_vertices: vertices found in the folder.

    Raises:
        FaceDiffError: if it tells neither frame rate nor vertices.
    """
    from facediff.data.corpus import parse_name

    person, rate, vertices = manifest["person"], manifest.get("frame_rate"), manifest.get("n_vertices", n_vertices)
    if not (is_rate(rate) and isinstance(vertices, int) and vertices > 0):
        raise FaceDiffError(f"does not tell both frame rate and vertices of {person}; import the person anew")

    def split(clip: Clip) -> str | None:
        said = clip.attributes.get("split")
        return "test_a" if said == "test" else said

    return View(
        corpus="person",
        data_module=None,
        n_vertices=vertices,
        frame_rate=rate,
        stored_frame_rate=rate,
        parse=parse_name,
        split_of={None: split},
        identities=[person],
    )


# Recognising what is not a corpus yet: data sets as they are distributed.

LOOKED_FOR = {
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
"""Files that a raw distribution has, by the name under which ``facediff data prepare`` knows it."""

BASES = 100
"""Folders in the raw folder that are looked into: one of them may be what an archive unpacked to."""


def raw_distribution(root: Path) -> tuple[str, str] | None:
    """The data set whose raw distribution a folder holds, and the file that tells it; None if it holds none."""
    for base in _bases(root):
        for corpus, patterns in LOOKED_FOR.items():
            for pattern in patterns:
                found = _first(base, pattern)
                if found is not None:
                    return corpus, found.relative_to(root).as_posix()
    return None


def prepare_command(corpus: str, root: Path) -> str:
    """What to run to make a corpus folder of a raw distribution."""
    return f"facediff data prepare {corpus} {root} OUT" + (" --flame MODEL" if corpus == "mead3d" else "")


def _bases(root: Path) -> Iterator[Path]:
    yield root
    try:
        yield from islice((path for path in sorted(root.iterdir()) if path.is_dir()), BASES)
    except OSError:
        return


def _first(base: Path, pattern: str) -> Path | None:
    try:
        return next(base.glob(pattern), None)
    except OSError:
        return None


def identify(
    report: Report, folder: Folder, said: object, corpus: str | None, split: str | None, manifest: dict[str, Any]
) -> View | None:
    """The corpus that a folder holds; None, with a finding, if it holds none or cannot be told."""
    root, n_vertices = folder.root, folder.n_vertices()
    module = None if corpus is None else by_name(corpus, n_vertices)
    if not folder.motions and (raw := raw_distribution(root)) is not None:
        report.raw = raw[0]
        message = f"this is the raw distribution of {raw[0]} and no corpus yet: run `{prepare_command(raw[0], root)}`"
        report.findings.append(Finding("error", "raw", raw[1], message))
        return None
    if module is None and isinstance(manifest.get("person"), str):
        view: View | None = None
        with guarded(report.findings, "manifest_unreadable", root / MANIFEST, root):
            view = view_of_person(manifest, n_vertices)
        return view
    module = module or recognise(folder, said, n_vertices)
    if module is None:
        report.findings.append(_unrecognised(folder, said, n_vertices))
        return None
    return view_of(module, root, split)


def _unrecognised(folder: Folder, said: object, n_vertices: int | None) -> Finding:
    have = [
        f"no {MANIFEST} names a corpus" if said is None else f"{MANIFEST} names {said!r}, which no data module reads"
    ]
    if folder.names:
        vertices = "unreadable motion" if n_vertices is None else f"{number(n_vertices)} vertices"
        have.append(f"there are clips {few(folder.names)} with {vertices}, which fit none of {few(_corpora())}")
    else:
        patterns = ", ".join(pattern for patterns in LOOKED_FOR.values() for pattern in patterns)
        have.append(f"there is no wav/*.wav or vertices_npy/*.npy, and nothing of a raw distribution ({patterns})")
    message = f"not recognised: {'; '.join(have)}. Give the right folder, or say what it is with --corpus"
    return Finding("error", "unrecognised", str(folder.root), message)


def _corpora() -> Iterable[str]:
    return dict.fromkeys(str(named(module)) for module in known())
