"""Corpora in parameters as distributed or recorded: BEAT, takes of Live Link Face, clips of FLAME coefficients.

Nothing is prepared: the files are read as they lie in their folders, each with a sound file of the same name.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

from facediff import registry
from facediff.data.corpus import Clip
from facediff.data.datamodule import SpeechMotionDataModule, by_speaker, split_in_table
from facediff.data.packed.stores import is_packed
from facediff.data.person.importer import splits
from facediff.data.recordings import USUAL_SUFFIXES, RecordingFolder
from facediff.errors import FaceDiffError, check_known
from facediff.spaces import Space, layout
from facediff.spaces.layouts import LAYOUTS
from facediff.utils.licences import Commercial


class ParametricDataModule(SpeechMotionDataModule):
    """Recordings in parameters below a folder.

    ``clips.csv`` decides which split a clip belongs to, by its column ``split`` (train, val, test_a); without it, the
    last 15 % of each speaker's clips by name are for the test and the 10 % before them for validation.

    Class attributes:
        suffixes: of the files with values.
        names_channels: whether files name their channels, so that a folder is recognised without its layout.

    Args:
        root: the folder.
        extra_identities: speakers of the folder to train on; all that it has if None. Test clips of others are test_b.
        options: as for every data module.
    """

    unit = "m"
    identities: list[str] = []  # noqa: RUF012 - of a class, as those of all corpora; those of a folder are found in it
    suffixes: ClassVar[tuple[str, ...]] = USUAL_SUFFIXES
    names_channels: ClassVar[bool] = True
    layout_name: str | None = None

    def __init__(self, *, root: str, extra_identities: list[str] | None = None, **options: Any) -> None:  # noqa: ANN401
        speakers = extra_identities or self.speakers_in(Path(root).expanduser())
        super().__init__(root=root, extra_identities=speakers, **options)

    @classmethod
    def speakers_in(cls, root: Path) -> list[str]:
        """The speakers of a folder by the names of its files, sorted; none if there is no such folder."""
        recordings = RecordingFolder(root, layout("arkit"), cls.frame_rate, suffixes=cls.suffixes)
        clips = (cls.parse_name(name) for name in (recordings.names() if root.is_dir() else []))
        return sorted({clip.identity for clip in clips if clip is not None})

    @classmethod
    def check_root(cls, root: str | Path) -> None:
        """Refuse a folder without recordings: their speakers are the model's identities."""
        folder = Path(root).expanduser()
        if is_packed(root):  # is refused when it is read
            return
        if not cls.speakers_in(folder):
            expected = f"{' or '.join(cls.suffixes)}, each with a .wav of its name"
            raise FaceDiffError(
                f"{folder}: holds no recordings of {cls.corpus_name}; expected {expected}: put them there, or give "
                f"their folder as data.root (--data-root). {cls.obtain}".rstrip()
            )

    def channel_folder(self) -> RecordingFolder:
        """The recordings."""
        return RecordingFolder(self.root, self.space, self.frame_rate, suffixes=self.suffixes, layout=self.layout_name)

    @cached_property
    def _splits(self) -> dict[str, str]:
        """The splits of clips by the order of their speaker's clips."""
        result: dict[str, str] = {}
        for clips in by_speaker(clip for clip in self.corpus.clips.values() if clip.root == self.root).values():
            names = sorted(clip.name for clip in clips)
            result |= dict(zip(names, splits(len(names)), strict=True))
        return result

    def split_of(self, clip: Clip) -> str | None:
        """By ``clips.csv``, or by the order of each speaker's clips."""
        if clip.attributes.get("split"):
            return split_in_table(clip)
        split = self._splits[clip.name]
        return "test_a" if split == "test" else split

    def find_split(self, clip: Clip) -> str | None:
        """As of every data module, but clips of no split stay so, and speakers who are not trained on are unseen."""
        if clip.root in self.people:
            return super().find_split(clip)
        split = self.split_of(clip)
        if clip.identity in self.extra_identities:
            return split
        return "test_b" if split == "test_a" else None


@registry.corpus.register("BEAT")
class Beat(ParametricDataModule):
    """BEAT (Liu et al. 2022): ARKit's weights without tongueOut of people who speak and converse, with emotions.

    Files are named ``speaker_name_type_start_end.json`` and ``.wav`` as distributed, in any folders below the root; 60
    frames a second become 30. The emotion, by the number of the recording, is what style references share.

    Args:
        root: the folder.
        conversations: use recordings of conversations (types 1, 3, 5, 7) as well as of speeches (0, 2, 4, 6).
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "beat"
    frame_rate: ClassVar[float] = 30.0
    suffixes: ClassVar[tuple[str, ...]] = (".json",)
    space: Space = layout("arkit_51")
    n_vertices = len(layout("arkit_51").channels)
    reference_attributes: ClassVar[tuple[str, ...]] = ("emotion",)
    licence: ClassVar[str] = "BEAT's terms"
    languages: ClassVar[tuple[str, ...]] = ("en", "zh", "es", "ja")
    commercial_use: ClassVar[Commercial] = "unknown"
    licence_source: ClassVar[str] = "pantomatrix.github.io/BEAT"
    obtain: ClassVar[str] = "BEAT is distributed at pantomatrix.github.io/BEAT; put its .json and .wav files into it."

    def __init__(self, *, root: str, conversations: bool = False, **options: Any) -> None:  # noqa: ANN401
        super().__init__(root=root, **options)
        self.conversations = conversations

    @classmethod
    def parse_name(cls, name: str) -> Clip | None:
        """``26_reamey_0_103_103``: speaker, name, type, first and last number of the text."""
        match = re.fullmatch(r"(\d{1,2}_[a-z]+)_([0-7])_(\d{1,3})_(\d{1,3})", name)
        if match is None:
            return None
        kind, number = int(match[2]), int(match[3])
        form = "conversation" if kind % 2 else "speech"
        return Clip(name, match[1], f"{match[2]}_{match[3]}_{match[4]}", {"emotion": emotion_of(number), "form": form})

    def split_of(self, clip: Clip) -> str | None:
        """As in every folder of recordings, conversations aside."""
        if clip.attributes["form"] == "conversation" and not self.conversations:
            return None
        return super().split_of(clip)


EMOTIONS = (
    (64, "neutral"),
    (72, "happiness"),
    (80, "anger"),
    (86, "sadness"),
    (94, "contempt"),
    (102, "surprise"),
    (110, "fear"),
    (118, "disgust"),
)


def emotion_of(number: int) -> str:
    """The emotion of a recording by its first number.

    Example:
        >>> emotion_of(64), emotion_of(103)
        ('neutral', 'fear')
    """
    return next((emotion for last, emotion in EMOTIONS if number <= last), "neutral")


@registry.corpus.register("LiveLink")
class LiveLink(ParametricDataModule):
    """Takes of Live Link Face: ARKit's 52 weights, head and eyes, as ``facediff data import-take`` writes them.

    Or recordings of one's own, in step with their sound: ``speaker_sentence.csv`` with ``speaker_sentence.wav``.

    Args:
        root: the folder.
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "live_link"
    frame_rate: ClassVar[float] = 30.0
    suffixes: ClassVar[tuple[str, ...]] = (".csv",)
    space: Space = layout("live_link")
    n_vertices = len(layout("live_link").channels)
    licence: ClassVar[str] = "of its owner"


@registry.corpus.register("FlameClips")
class FlameClips(ParametricDataModule):
    """Clips of FLAME coefficients: ``speaker_sentence.npz`` (``.npy``, ``.pt``, ``.hdf5``), and a ``.wav`` of its name.

    Args:
        root: the folder.
        layout: name of the files' layout, such as flame_diffposetalk; an array does not say it.
        version: of FLAME: coefficients of 2020 and 2023 cannot be exchanged, and checkpoints keep it.
        options: as for every data module.
    """

    corpus_name: ClassVar[str] = "flame_clips"
    names_channels: ClassVar[bool] = False
    frame_rate: ClassVar[float] = 25.0
    suffixes: ClassVar[tuple[str, ...]] = (".npz", ".npy", ".pt", ".hdf5")
    space: Space = layout("flame_diffposetalk")
    n_vertices = len(layout("flame_diffposetalk").channels)
    licence: ClassVar[str] = "of its owner, and FLAME's"

    def __init__(self, *, root: str, layout: str, version: str = "", **options: Any) -> None:  # noqa: ANN401
        flame = [name for name, entry in LAYOUTS.items() if entry.space.kind == "flame"]
        check_known("data.layout", "layout of FLAME", [layout], flame)
        self.space = replace(LAYOUTS[layout].space, version=version)
        self.layout_name = layout
        self.n_vertices = len(self.space.channels)
        super().__init__(root=root, **options)
