"""Finding 3DMEAD's clips and MEAD's sound in raw folders."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from facediff.errors import FaceDiffError

EMOTIONS = ("neutral", "happy", "sad", "surprised", "fear", "disgusted", "angry", "contempt")
"""In the order of the index in clip names."""
LEVELS = (1, 2, 3)
RECONSTRUCTION = "shape_pose_cam.hdf5"
SOUND_SUFFIXES = (".wav", ".flac", ".m4a", ".mp4", ".aac", ".mp3", ".ogg")
"""The first that is there is taken: what is converted already comes first."""
DEPTH = 3
"""Folders in folders that are looked into, as ``processed/reconstructions/EMICA-MEAD_flame2020`` of inferno."""

SPEAKER = re.compile(r"[MW]\d{3}")
NUMBER = re.compile(r"\d{1,3}")
CLIP = re.compile(r"([MW]\d{3})_(\d{3})_([0-7])_([0-2])")


@dataclass(frozen=True, order=True)
class Recording:
    """One clip of the raw data.

    Attributes:
        name: e.g. ``M003_001_0_0``: speaker, sequence, index of emotion, index of intensity.
        file: its parameters.
    """

    name: str
    file: Path

    @property
    def subject(self) -> str:
        """Who speaks."""
        return self.name[:4]

    @property
    def sequence(self) -> str:
        """Three digits. The same number says the same words within one emotion only."""
        return self.name[5:8]

    @property
    def emotion(self) -> str:
        """In a word."""
        return EMOTIONS[int(self.name[9])]

    @property
    def level(self) -> int:
        """Intensity, 1 to 3."""
        return int(self.name[11]) + 1

    @property
    def sound(self) -> str:
        """Where MEAD has its sound, below the folder with the speakers."""
        return f"{self.subject}/audio/{self.emotion}/level_{self.level}/{self.sequence}.m4a"


@dataclass
class Found:
    """What a raw folder holds.

    Attributes:
        base: the folder with the speakers' folders, or with ``param/``.
        recordings: every clip, sorted by name.
        missing: clips without parameters, and where they were expected.
    """

    base: Path
    recordings: list[Recording] = field(default_factory=list)
    missing: dict[str, str] = field(default_factory=dict)


def find_recordings(raw: Path) -> Found:
    """Every clip of a raw folder, which holds EMOTE's distribution or ProbTalk3D's; they are told apart by looking.

    Raises:
        FaceDiffError: if there is neither, or more than one.
    """
    places = [folder for folder in folders(raw) if _is_emote(folder) or _is_probtalk3d(folder)]
    if not places:
        raise FaceDiffError(
            f"{raw}: holds no reconstructions of MEAD; expected <speaker>/front/<emotion>/level_<k>/<number>/"
            f"{RECONSTRUCTION} as EMOTE's authors give them out, or param/<speaker>_<number>_<emotion>_<intensity>.npy "
            f"of ProbTalk3D"
        )
    if len(places) > 1:
        raise FaceDiffError(
            f"{raw}: holds reconstructions in {places[0]} and in {places[1]}; give one of these folders instead"
        )
    found = _probtalk3d(places[0]) if _is_probtalk3d(places[0]) else _emote(places[0])
    found.recordings = sorted({recording.name: recording for recording in found.recordings}.values())
    return found


def folders(root: Path, depth: int = DEPTH) -> Iterator[Path]:
    """A folder and those in it, but not what lies in a speaker's folder or in a hidden one.

    Raises:
        FaceDiffError: if there is no such folder or it cannot be read.
    """
    if not root.is_dir():
        raise FaceDiffError(f"{root}: no such folder; expected the data as it was distributed, unpacked")
    try:
        inner = sorted(path for path in root.iterdir() if path.is_dir())
    except OSError as error:
        raise FaceDiffError(f"{root}: cannot be read ({error.strerror}); check its permissions") from error
    yield root
    for folder in inner if depth else ():
        if not folder.name.startswith(".") and not SPEAKER.fullmatch(folder.name):
            yield from folders(folder, depth - 1)


def speakers(folder: Path) -> list[Path]:
    """The speakers' folders in a folder, sorted."""
    return sorted(path for path in folder.iterdir() if SPEAKER.fullmatch(path.name) and path.is_dir())


def _is_emote(folder: Path) -> bool:
    return any((speaker / "front").is_dir() for speaker in speakers(folder))


def _is_probtalk3d(folder: Path) -> bool:
    return any(CLIP.fullmatch(path.stem) for path in folder.glob("param/*.npy"))


def _probtalk3d(base: Path) -> Found:
    files = (path for path in base.glob("param/*.npy") if CLIP.fullmatch(path.stem) and path.is_file())
    return Found(base, [Recording(path.stem, path) for path in files])


def _emote(base: Path) -> Found:
    found = Found(base)
    for speaker in speakers(base):
        for name, folder in _numbered(speaker / "front", speaker.name):
            file = folder / RECONSTRUCTION
            if file.is_file():
                found.recordings.append(Recording(name, file))
            elif folder.is_dir():
                found.missing[name] = f"expected {file}"
    return found


def _numbered(place: Path, speaker: str) -> Iterator[tuple[str, Path]]:
    """What lies in ``<emotion>/level_<k>/`` below a place and is named by a number, with its clip's name."""
    for index, emotion in enumerate(EMOTIONS):
        for level in LEVELS:
            folder = place / emotion / f"level_{level}"
            for path in sorted(folder.iterdir()) if folder.is_dir() else ():
                if NUMBER.fullmatch(path.stem):
                    yield f"{speaker}_{int(path.stem):03d}_{index}_{level - 1}", path


def find_sounds(place: Path) -> dict[str, Path]:
    """Sound of every clip below a folder, by the clip's name.

    MEAD has it in ``<speaker>/audio/<emotion>/level_<k>/<number>.m4a``; converted files may lie in the same place, in
    ``<speaker>/<emotion>/level_<k>/``, or under the clip's name in one folder.

    Raises:
        FaceDiffError: if there is no such folder or it cannot be read.
    """
    best: dict[str, tuple[int, Path]] = {}
    for folder in folders(place):
        named = [(path.stem, path) for path in sorted(folder.iterdir()) if CLIP.fullmatch(path.stem)]
        for speaker in speakers(folder):
            for inner in (speaker / "audio", speaker):
                named += _numbered(inner, speaker.name)
        for name, path in named:
            suffix = path.suffix.lower()
            if suffix in SOUND_SUFFIXES and path.is_file():
                best[name] = min(best.get(name, (len(SOUND_SUFFIXES), path)), (SOUND_SUFFIXES.index(suffix), path))
    return {name: path for name, (_, path) in best.items()}
