"""Storage of motion and speech of clips: a folder of files; :mod:`facediff.data.packed` has the other one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.speech.audio import read_stretch
from facediff.utils.arrays import ArrayStore, in_range, open_array, open_vertices
from facediff.utils.limits import COORDINATE, LIMITS, quoted

MOTION_FOLDERS = ("vertices_npy", "vertex")
"""Folders with absolute vertices, in order of preference; the second is ProbTalk3D's."""

WEIGHTS_FOLDER, RIGS_FOLDER = "weights_npy", "rigs"
"""Where a corpus keeps motion as weights of shapes, and each speaker's shapes."""

CHUNK = 8
"""Frames that are converted at a time: few enough to stay in a processor's cache, many enough to cost no overhead."""


class ClipMotion(Protocol):
    """The motion of one clip, opened."""

    @property
    def frames(self) -> int:
        """Stored frames, before any is left out."""

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template (len(picks), V, 3) of stored frames; numbers past the end are left out."""


class ClipStorage(Protocol):
    """Motion and speech of clips, by name."""

    def names(self) -> list[str]:
        """The clips that have both motion and speech, sorted."""

    def open(self, name: str) -> ClipMotion:
        """Open the motion of a clip."""

    def speech(self, name: str, first: int, length: int, store: ArrayStore) -> npt.NDArray[np.float32]:
        """Samples of a clip's speech at 16 kHz (length,), filled with zeros past its end."""

    def version(self, name: str) -> object:
        """A value that changes when the clip's motion changes."""


class ClipFolder:
    """Clips as files of a folder, ``wav/<clip>.wav`` and ``vertices_npy/<clip>.npy``, which are memory-mapped.

    Motion may also be kept as weights, ``weights_npy/<identity>_<sentence>.npy`` with ``rigs/<identity>.npy``; where a
    clip has both, the vertices are read.

    Args:
        root: the folder.
        n_vertices: vertices of its meshes.
    """

    def __init__(self, root: Path, n_vertices: int) -> None:
        self.root = root
        self.n_vertices = n_vertices
        self._rigs: dict[str, npt.NDArray[np.floating]] = {}

    def names(self) -> list[str]:
        """The clips that have both files, sorted."""
        names = []
        for name in sorted(path.stem for path in (self.root / "wav").glob("*.wav")):
            if not name.isprintable():
                raise FaceDiffError(
                    f"{self.root / 'wav'}: has a file {quoted(name)}; rename it, its name cannot be printed"
                )
            if self._path(name).is_file():
                names.append(name)
        return names

    def _path(self, name: str) -> Path:
        """The file that holds a clip's motion."""
        vertices, weights = motion_path(self.root, name), self.root / WEIGHTS_FOLDER / f"{name}.npy"
        return weights if weights.is_file() and not vertices.is_file() else vertices

    def open(self, name: str) -> ClipMotion:
        """Map a clip's file into memory."""
        path = self._path(name)
        if path.parent.name != WEIGHTS_FOLDER:
            return VertexFile(path, self.n_vertices)
        return WeightFile(path, self._rig(name.rpartition("_")[0]))

    def _rig(self, identity: str) -> npt.NDArray[np.floating]:
        """A speaker's shapes, which all of their clips share."""
        if identity not in self._rigs:
            self._rigs[identity] = open_vertices(self.root / RIGS_FOLDER / f"{identity}.npy", self.n_vertices)
        return self._rigs[identity]

    def speech(self, name: str, first: int, length: int, store: ArrayStore) -> npt.NDArray[np.float32]:
        """Samples of the clip's .wav file; see :func:`~facediff.speech.audio.read_stretch`."""
        return read_stretch(self.root / "wav" / f"{name}.wav", first, length, store)

    def version(self, name: str) -> object:
        """Size and time of the clip's motion file."""
        facts = self._path(name).stat()
        return facts.st_size, facts.st_mtime_ns


class VertexFile:
    """Absolute vertices of a clip in a ``.npy`` file.

    Args:
        path: the file.
        n_vertices: vertices of its mesh.
    """

    def __init__(self, path: Path, n_vertices: int) -> None:
        self.path = path
        self.vertices = open_vertices(path, n_vertices)

    @property
    def frames(self) -> int:
        """Frames in the file."""
        return len(self.vertices)

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template of some frames; only these are read."""
        picks = within(picks, self.frames)
        if isinstance(picks, range):
            stored = self.vertices[picks.start : picks.stop : picks.step]
        else:
            stored = self.vertices[np.array(picks, np.intp)]
        motion = np.empty(stored.shape, np.float32)
        # Conversion, check and subtraction go over each chunk while it is in the processor's cache: done one after the
        # other over the whole clip, each would wait for main memory.
        for first in range(0, len(stored), CHUNK):
            chunk = motion[first : first + CHUNK]
            with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
                np.copyto(chunk, stored[first : first + CHUNK], casting="same_kind")
            refuse_out_of_range(chunk, picks[first : first + CHUNK], self.path)
            chunk -= template
        return motion


class WeightFile:
    """Motion of a clip as weights of a speaker's shapes, decoded to vertices frame by frame.

    Args:
        path: the ``.npy`` file of weights (T, K).
        rig: the speaker's face at rest, followed by the displacements of the shapes at weight 1, (1 + K, V, 3).
    """

    def __init__(self, path: Path, rig: npt.NDArray[np.floating]) -> None:
        self.path = path
        self.weights = open_array(path, kinds="f")
        self.rig = rig
        if self.weights.ndim != 2 or not len(self.weights) or self.weights.shape[1] != len(rig) - 1:
            raise FaceDiffError(
                f"{path}: has shape {self.weights.shape}; expected (frames, {len(rig) - 1}), the weights of the "
                f"speaker's shapes in {RIGS_FOLDER}"
            )
        LIMITS.check("frames", len(self.weights), path)

    @property
    def frames(self) -> int:
        """Frames in the file."""
        return len(self.weights)

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template of some frames."""
        picks = within(picks, self.frames)
        weights = np.asarray(self.weights[np.array(picks, np.intp)], np.float32)
        shapes = np.asarray(self.rig[1:], np.float32).reshape(len(self.rig) - 1, -1)
        motion = (weights @ shapes).reshape(len(weights), -1, 3)
        motion += np.asarray(self.rig[0], np.float32)
        refuse_out_of_range(motion, picks, self.path)
        motion -= template
        return motion


def within(picks: Sequence[int], frames: int) -> Sequence[int]:
    """The numbers that are below ``frames``; of a range (upwards) a range."""
    if isinstance(picks, range):
        return range(picks.start, min(picks.stop, frames), picks.step)
    return [pick for pick in picks if pick < frames]


def refuse_out_of_range(vertices: npt.NDArray[np.float32], numbers: Sequence[int], source: object) -> None:
    """Refuse absolute vertices (T, V, 3) that are not finite, or so large that their squares are infinite in float32.

    Args:
        vertices: the frames.
        numbers: the frames' numbers in the clip, for the message.
        source: the clip's file.
    """
    if not in_range(vertices):
        bad = int(np.argmax(~(np.abs(vertices) <= COORDINATE).all((1, 2))))
        raise FaceDiffError(
            f"{source}: frame {numbers[bad]} holds NaN, infinity or a coordinate beyond {COORDINATE:g} (counted from "
            f"0); remove the clip"
        )


def motion_path(root: Path, name: str) -> Path:
    """The file with a clip's vertices; the usual place if there is none."""
    paths = [root / folder / f"{name}.npy" for folder in MOTION_FOLDERS]
    return next((path for path in paths if path.is_file()), paths[0])
