"""Storage of motion and speech of clips: a folder of files; :mod:`facediff.data.packed` has the other one."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.spaces import Space
from facediff.speech.audio import read_stretch
from facediff.utils.arrays import ArrayStore, open_array, open_vertices
from facediff.utils.limits import COORDINATE, in_range
from facediff.utils.paths import find_file, name_of_file

MOTION_FOLDERS = ("vertices_npy", "vertex")
"""Folders with absolute vertices, in order of preference; the second is ProbTalk3D's."""

WEIGHTS_FOLDER, RIGS_FOLDER = "weights_npy", "rigs"
"""Where a corpus keeps motion as weights of shapes, and each speaker's shapes."""

VALUES_FOLDER = "values_npy"
"""Where a corpus of a parametric space keeps the channels of each clip, (frames, channels)."""

CHUNK = 8
"""Frames that are converted at a time: few enough to stay in a processor's cache, many enough to cost no overhead."""


class ClipMotion(Protocol):
    """The motion of one clip, opened."""

    @property
    def frames(self) -> int:
        """Stored frames, before any is left out."""

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template (len(picks), V, dims) of stored frames; numbers past the end are left out."""


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
        self._complete: set[Path] = set()

    def names(self) -> list[str]:
        """The clips that have both files, sorted."""
        names = sorted({name_of_file(path) for path in (self.root / "wav").glob("[!.]*.wav")})
        return [name for name in names if self.path_of(name).is_file()]

    def path_of(self, name: str) -> Path:
        """The file with a clip's motion."""
        return motion_path(self.root, name)

    def open(self, name: str) -> ClipMotion:
        """Map a clip's file into memory."""
        return open_motion(self.path_of(name), self.n_vertices)

    def speech(self, name: str, first: int, length: int, store: ArrayStore) -> npt.NDArray[np.float32]:
        """Samples of the clip's .wav file; see :func:`~facediff.speech.audio.read_stretch`."""
        return read_stretch(self.sound_path(name), first, length, store, self._complete)

    def sound_path(self, name: str) -> Path:
        """The file with a clip's speech."""
        return find_file(self.root / "wav" / f"{name}.wav")

    def version(self, name: str) -> object:
        """Size and time of the clip's motion file."""
        status = self.path_of(name).stat()
        return status.st_size, status.st_mtime_ns


class ChannelFolder(ClipFolder):
    """The same with channels of a parametric space, ``values_npy/<clip>.npy``.

    Args:
        root: the folder.
        space: the space that the channels are of.
    """

    folder: str = VALUES_FOLDER

    def __init__(self, root: Path, space: Space) -> None:
        super().__init__(root, len(space.channels))
        self.space = space

    def path_of(self, name: str) -> Path:
        """The file with a clip's channels."""
        return find_file(self.root / self.folder / f"{name}.npy")

    def open(self, name: str) -> ClipMotion:
        """Read a clip's channels."""
        return ChannelMotion(self.path_of(name), self.values(name), self.space)

    def values(self, name: str) -> npt.NDArray[np.floating]:
        """A clip's channels (frames, channels) as they are stored."""
        return open_array(self.path_of(name), kinds="f")


class ChannelMotion:
    """Channels of a clip.

    Args:
        path: their file, for messages.
        values: (frames, channels).
        space: the space that they are of.
    """

    def __init__(self, path: Path, values: npt.NDArray[np.floating], space: Space) -> None:
        self.path, self.values = path, values
        if values.ndim != 2 or not len(values) or values.shape[1] != len(space.channels):
            raise FaceDiffError(
                f"{path}: has shape {values.shape}; expected (frames, {len(space.channels)}), the channels of the "
                f"corpus's space ({space.kind})"
            )

    @property
    def frames(self) -> int:
        """Stored frames."""
        return len(self.values)

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the resting values (channels, 1) of some frames, (len(picks), channels, 1)."""
        picks = within(picks, self.frames)
        motion = np.asarray(self.values[np.array(picks, np.intp)], np.float32)[..., None]
        refuse_out_of_range(motion, picks, self.path)
        return motion - template


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

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the stored numbers."""
        return self.vertices.dtype

    def read(self, picks: Sequence[int]) -> npt.NDArray[np.floating]:
        """Absolute vertices (len(picks), V, 3) of some frames, as they are stored."""
        return self.vertices[slice(picks.start, picks.stop, picks.step) if isinstance(picks, range) else picks]

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template of some frames; only these are read."""
        picks = within(picks, self.frames)
        stored = self.read(picks)
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

    @property
    def frames(self) -> int:
        """Frames in the file."""
        return len(self.weights)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of the decoded numbers."""
        return np.dtype(np.float32)

    def read(self, picks: Sequence[int]) -> npt.NDArray[np.float32]:
        """Absolute vertices (len(picks), V, 3) of some frames."""
        return self.decode(np.asarray(self.weights[np.array(picks, np.intp)], np.float32))

    def decode(self, weights: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Absolute vertices (T, V, 3) of some weights (T, K)."""
        shapes = np.asarray(self.rig[1:], np.float32).reshape(len(self.rig) - 1, -1)
        motion = (weights @ shapes).reshape(len(weights), -1, 3)
        motion += np.asarray(self.rig[0], np.float32)
        return motion

    def checked(self, picks: Sequence[int]) -> npt.NDArray[np.float32]:
        """The weights (at most len(picks), K) of some frames, for those who do not decode them."""
        picks = within(picks, self.frames)
        weights = np.asarray(self.weights[np.array(picks, np.intp)], np.float32)
        refuse_out_of_range(weights[..., None], picks, self.path)
        return weights

    def offsets(self, picks: Sequence[int], template: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Offsets from the template of some frames."""
        picks = within(picks, self.frames)
        motion = self.read(picks)
        refuse_out_of_range(motion, picks, self.path)
        motion -= template
        return motion


def within(picks: Sequence[int], frames: int) -> Sequence[int]:
    """The numbers that are below ``frames``; of a range (upwards) a range."""
    if isinstance(picks, range):
        return range(picks.start, min(picks.stop, frames), picks.step)
    return [pick for pick in picks if pick < frames]


def refuse_out_of_range(vertices: npt.NDArray[np.float32], numbers: Sequence[int], source: object) -> None:
    """Refuse vertices (T, V, 3) that are not finite, or so large that their squares are infinite in float32."""
    if not in_range(vertices):
        index = int(np.argmax(~(np.abs(vertices) <= COORDINATE).all((1, 2))))
        raise FaceDiffError(
            f"{source}: frame {numbers[index]} holds NaN, infinity or a coordinate beyond {COORDINATE:g} (counted from "
            f"0); remove the clip"
        )


def open_motion(path: Path, n_vertices: int) -> VertexFile | WeightFile:
    """The motion in a file of vertices, or in one of weights with the speaker's shapes next to it."""
    rig = rig_path(path)
    return VertexFile(path, n_vertices) if rig is None else WeightFile(path, open_vertices(rig, n_vertices))


def rig_path(path: Path) -> Path | None:
    """The file of the shapes that belong to a file of weights, ``<identity>_<sentence>.npy``; None for vertices."""
    if path.parent.name != WEIGHTS_FOLDER:
        return None
    return path.parent.parent / RIGS_FOLDER / f"{path.stem.rpartition('_')[0]}.npy"


def motion_path(root: Path, name: str) -> Path:
    """The file with a clip's vertices, or else weights; the usual place if there is none."""
    paths = [find_file(root / folder / f"{name}.npy") for folder in (*MOTION_FOLDERS, WEIGHTS_FOLDER)]
    return next((path for path in paths if path.is_file()), paths[0])
