"""What lies in a corpus folder, by name only."""

from __future__ import annotations

import os
from collections import Counter
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path

from facediff.doctor.motion import open_array, vertices_of
from facediff.errors import FaceDiffError

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
                found = vertices_of(open_array(path))
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
