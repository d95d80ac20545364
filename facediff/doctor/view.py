"""What the doctor needs to know about a corpus, whether a data module tells it or a person's own folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeGuard

from facediff.doctor.corpora import variants
from facediff.errors import FaceDiffError, choices

if TYPE_CHECKING:
    from facediff.data import SpeechMotionDataModule
    from facediff.data.corpus import Clip, Corpus

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
