"""Corpora of people's videos, as ``facediff data track`` writes them."""

from __future__ import annotations

import hashlib
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, ClassVar

from facediff import registry
from facediff.data.corpus import Clip, read_clip_table, read_manifest
from facediff.data.datamodule import SpeechMotionDataModule, by_speaker, person_licence
from facediff.data.packed.reader import PackedCorpus
from facediff.data.packed.stores import is_packed
from facediff.errors import FaceDiffError, check_known
from facediff.utils.licences import Licence, merged, read_licences
from facediff.utils.ranges import Range

FEW = 4
"""Up to so many people, all are trained on."""
REFERENCE_SHARE = 3
"""One in so many clips of a person who is not trained on is a style reference."""


def people_of(root: Path) -> list[str]:
    """The people of a corpus, by its manifest, sorted; none where there is no such folder."""
    people = read_manifest(root).get("people") if root.is_dir() else None
    return sorted(people) if isinstance(people, dict) else []


def small_files(root: str | Path) -> Path:
    """The folder of a corpus, or of all files of a packed one but its motion and speech."""
    return PackedCorpus(root).folder if is_packed(root) else Path(root).expanduser()


def unseen_people(names: list[str], share: float) -> list[str]:
    """People who are kept out of training: a share of more than four, by a hash of their names.

    Example:
        >>> unseen_people(["Ada", "Ben", "Cleo", "Dan", "Eve"], 0.2)
        ['Ben']
    """
    count = round(share * len(names)) if len(names) > FEW else 0
    return sorted(sorted(names, key=lambda name: hashlib.sha256(name.encode()).hexdigest())[:count])


@registry.corpus.register("People")
class People(SpeechMotionDataModule):
    """People's faces as ``facediff data track`` finds them in videos: 468 vertices, metres.

    Of a person who is trained on, the last 15 % of the clips are test A and the 10 % before them validation, unless
    ``clips.csv`` says otherwise. Of more than four people a share is test B: of their clips, one in three is a style
    reference. A person's only clip belongs to no split.

    Args:
        root: the corpus folder.
        extra_identities: people to train on; all but the people of test B if None.
        test_people: share of the people who are test B.
        options: of every data module.
    """

    corpus_name: ClassVar[str] = "people"
    unit = "m"
    frame_rate: ClassVar[float] = 25.0  # of an instance, that of its folder
    n_vertices = 468
    identities: list[str] = []  # noqa: RUF012 - of a class, as those of all corpora; those of a folder are found in it
    mesh_files: ClassVar[tuple[str, ...]] = ("people.ply",)
    licence: ClassVar[str] = "that of the videos, see manifest.json"
    obtain: ClassVar[str] = "`facediff data track VIDEOS -o FOLDER` makes it of videos."

    def __init__(
        self,
        *,
        root: str,
        extra_identities: list[str] | None = None,
        test_people: Annotated[float, Range(0, 1)] = 0.2,
        **options: Any,  # noqa: ANN401
    ) -> None:
        folder = small_files(root)
        names = people_of(folder)
        unseen = unseen_people(names, test_people)
        identities = extra_identities or [name for name in names if name not in unseen]
        super().__init__(root=root, extra_identities=identities, **options)
        if folder.is_dir():
            self.frame_rate = float(read_manifest(folder).get("frame_rate") or 25)  # type: ignore[misc]

    @classmethod
    def check_root(cls, root: str | Path) -> None:
        """Refuse a folder without people, who are the model's identities."""
        super().check_root(root)
        if not people_of(small_files(root)):
            raise FaceDiffError(f"{root}: its manifest.json names no people. {cls.obtain}")

    def licences(self) -> tuple[Licence, ...]:
        """The terms of the videos, as the folder states them."""
        manifest = self.root / "manifest.json"
        stated = read_manifest(self.root).get("licence") if self.root.is_dir() else None
        licences = read_licences(manifest, [stated]) if stated else [self.corpus_licence()]
        corpora = [data.licences() for data in self.further.values()]
        return merged(licences, map(person_licence, self.people), *corpora)

    @cached_property
    def _splits(self) -> dict[str, str | None]:
        table = {name: row.get("split", "none") for name, row in read_clip_table(self.root).items()}
        check_known(self.root / "clips.csv", "split", table.values(), ("train", "val", "test", "none"))
        by_person = by_speaker(clip for clip in self.corpus.clips.values() if clip.root == self.root)
        splits: dict[str, str | None] = {}
        for person, clips in by_person.items():
            for number, name in enumerate(names := sorted(clip.name for clip in clips)):
                split = {"test": "test_a", "none": None}.get(table.get(name, "none"), table.get(name))
                if person not in self.extra_identities:
                    split = None if number % REFERENCE_SHARE == 0 else "test_b"
                splits[name] = split if len(names) > 1 else None
        return splits

    def only_numbers(self, clip: Clip) -> bool:
        """Always: clips are counted by person."""
        return True

    def split_of(self, clip: Clip) -> str | None:
        """By ``clips.csv``, and by who is trained on."""
        return self._splits.get(clip.name)

    def find_split(self, clip: Clip) -> str | None:
        """As of every data module, but clips of no split stay so."""
        return super().find_split(clip) if clip.root in self.people else self.split_of(clip)
