"""Folders of recordings in parameters, read as they are: each a file of values and a sound file of the same name."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.storage import ChannelFolder
from facediff.errors import FaceDiffError
from facediff.spaces import Space
from facediff.spaces.files import ParameterClip, even, from_start, read_parameters
from facediff.spaces.operations import permuted
from facediff.speech.audio import read_stretch
from facediff.utils.arrays import ArrayStore
from facediff.utils.files import cache_dir
from facediff.utils.paths import find_file, name_of_file

USUAL_SUFFIXES = (".csv", ".json")
METHOD = 3
"""Goes up when the same recording is read in another way, so that values cached by an older version are not used."""


class RecordingFolder(ChannelFolder):
    """Recordings anywhere below a folder: ``<clip>.csv`` with ``<clip>.wav`` next to it or in ``wav/``.

    Values come in the order of the corpus's space and at its frame rate; both are kept in the cache, since a text of
    some megabytes is slow to read.

    Args:
        root: the folder.
        space: the space that is returned.
        frame_rate: frames a second that are returned.
        suffixes: of the files with values.
        layout: of arrays, which do not say theirs.
    """

    def __init__(
        self,
        root: Path,
        space: Space,
        frame_rate: float,
        *,
        suffixes: tuple[str, ...] = USUAL_SUFFIXES,
        layout: str | None = None,
    ) -> None:
        super().__init__(root, space)
        self.frame_rate, self.suffixes, self.layout = frame_rate, suffixes, layout
        self._store = ArrayStore(cache_dir() / "recordings")

    @cached_property
    def files(self) -> dict[str, tuple[Path, Path]]:
        """The files with values and speech of each recording, by name, sorted."""
        sounds = {name_of_file(path): path for path in (self.root / "wav").glob("*") if path.suffix.lower() == ".wav"}
        files: dict[str, tuple[Path, Path]] = {}
        for path in sorted(self.root.rglob("*")):
            if path.suffix.lower() not in self.suffixes or path.name.startswith(".") or not path.is_file():
                continue
            name = name_of_file(path)
            beside = (find_file(path.with_suffix(suffix)) for suffix in (".wav", ".WAV"))
            sound = next((sound for sound in beside if sound.is_file()), sounds.get(name))
            if sound is None or not sound.is_file():
                continue
            if name in files:
                raise FaceDiffError(f"{path}: is named as {files[name][0]} is; rename one of them")
            files[name] = (path, sound)
        return files

    def names(self) -> list[str]:
        """The recordings that have values and speech, sorted."""
        return sorted(self.files)

    def path_of(self, name: str) -> Path:
        """The file with a recording's values."""
        return self.files[name][0]

    def recording(self, name: str) -> ParameterClip:
        """A recording as its file has it."""
        return read_parameters(self.path_of(name), layout=self.layout)

    def values(self, name: str) -> npt.NDArray[np.floating]:
        """A recording's values in the corpus's space and at its frame rate; dropped frames are interpolated."""
        path = self.path_of(name)
        status = path.stat()
        parts = (path.resolve(), status.st_size, status.st_mtime_ns, self.space.state(), self.frame_rate, self.layout)
        key = ArrayStore.key(METHOD, *parts)
        stored = self._store.get(key)
        if stored is not None:
            return stored
        clip = even(self.recording(name))
        values, _ = permuted(clip.values, clip.space, self.space)
        clip = replace(clip, values=values, space=self.space)
        return self._store.put(key, from_start(clip, self.frame_rate).astype(np.float32))

    def speech(self, name: str, first: int, length: int, store: ArrayStore) -> npt.NDArray[np.float32]:
        """Samples of the recording's sound file; see :func:`~facediff.speech.audio.read_stretch`."""
        return read_stretch(self.files[name][1], first, length, store)
