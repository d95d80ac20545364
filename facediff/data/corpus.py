"""A corpus on disk in the layout that circulates in the field.

``wav/<clip>.wav``, ``vertices_npy/<clip>.npy`` with (T, 3V) absolute vertices, ``templates.pkl``, ``regions/*.txt``,
a mesh file with the faces, and optionally ``clips.csv`` with further columns per clip.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.data.audio import fit_length, read_speech, samples_for
from facediff.pickles import load_pickle
from facediff.errors import FaceDiffError
from facediff.metrics import Region
from facediff.topology.mesh import Mesh, read_mesh


@dataclass(frozen=True)
class Clip:
    """One recording.

    Attributes:
        name: ``<subject>_<sentence>``.
        subject: everything before the last underscore.
        sentence: everything after it.
        attributes: further columns of ``clips.csv``, e.g. the mood.
    """

    name: str
    subject: str
    sentence: str
    attributes: dict[str, str] = field(default_factory=dict, hash=False)

    @property
    def number(self) -> int:
        """The sentence's number: the last two characters, as every project of the field has it."""
        return int(self.sentence[-2:])


class Corpus:
    """Read access to one corpus folder. Motion is memory-mapped; nothing is kept in memory but the templates.

    Args:
        root: the folder.
        n_vertices: vertices of its meshes.
        frame_rate: motion frames a second.
    """

    def __init__(self, root: Path, n_vertices: int, frame_rate: float) -> None:
        self.root = root
        self.n_vertices = n_vertices
        self.frame_rate = frame_rate
        if not root.is_dir():
            raise FaceDiffError(f"{root}: no such folder; expected one with wav/, vertices_npy/ and templates.pkl")

    @cached_property
    def clips(self) -> dict[str, Clip]:
        """Every clip that has both speech and motion, by name, sorted."""
        attributes = self._attributes()
        names = sorted(path.stem for path in (self.root / "wav").glob("*.wav") if self.motion_path(path.stem).is_file())
        if not names:
            raise FaceDiffError(f"{self.root}: no clip found; expected wav/<clip>.wav beside vertices_npy/<clip>.npy")
        clips = {}
        for name in names:
            subject, _, sentence = name.rpartition("_")
            clips[name] = Clip(name, subject, sentence, attributes.get(name, {}))
        return clips

    def _attributes(self) -> dict[str, dict[str, str]]:
        path = self.root / "clips.csv"
        if not path.is_file():
            return {}
        with path.open(newline="", encoding="utf-8") as stream:
            return {row.pop("clip"): row for row in csv.DictReader(stream)}

    @cached_property
    def templates(self) -> dict[str, Tensor]:
        """Neutral face (V, 3) of every subject, float32."""
        path = self.root / "templates.pkl"
        loaded = load_pickle(path)
        if not isinstance(loaded, dict):
            raise FaceDiffError(f"{path}: expected a dict from subject to (V, 3) array, got {type(loaded).__name__}")
        return {str(name): torch.from_numpy(self._vertices(path, name, value)) for name, value in loaded.items()}

    def _vertices(self, path: Path, name: str, value: object) -> npt.NDArray[np.float32]:
        array = np.asarray(value, np.float32)
        if array.size != self.n_vertices * 3:
            raise FaceDiffError(
                f"{path}: the template of {name} has shape {array.shape}, expected ({self.n_vertices}, 3)"
            )
        return array.reshape(-1, 3)

    def motion_path(self, name: str) -> Path:
        """Where a clip's vertices lie."""
        return self.root / "vertices_npy" / f"{name}.npy"

    def open_vertices(self, clip: Clip) -> npt.NDArray[np.floating]:
        """A clip's absolute vertices (T, V, 3), memory-mapped."""
        path = self.motion_path(clip.name)
        try:
            array = np.load(path, mmap_mode="r", allow_pickle=False)
        except (ValueError, OSError, EOFError) as error:
            raise FaceDiffError(f"{path}: not a readable NumPy array ({error}); expected (T, 3V) floats") from error
        if array.ndim not in (2, 3) or array.size != len(array) * self.n_vertices * 3 or not len(array):
            raise FaceDiffError(
                f"{path}: has shape {array.shape}, expected (frames, {3 * self.n_vertices}) with at least one frame"
            )
        return array.reshape(len(array), self.n_vertices, 3)

    def frames(self, clip: Clip) -> int:
        """Number of motion frames of a clip."""
        return len(self.open_vertices(clip))

    def read_motion(self, clip: Clip, start: int = 0, stop: int | None = None) -> Tensor:
        """Offsets from the template (T, V, 3), float32; only the frames asked for are read."""
        if clip.subject not in self.templates:
            raise FaceDiffError(
                f"{self.root / 'templates.pkl'}: no template for {clip.subject}, needed by clip {clip.name}; "
                f"it has {', '.join(sorted(self.templates))}"
            )
        window = np.array(self.open_vertices(clip)[start:stop], np.float32)
        if not np.isfinite(window).all():
            bad = start + int(np.argmax(~np.isfinite(window).all((1, 2))))
            raise FaceDiffError(f"{self.motion_path(clip.name)}: frame {bad} holds NaN or infinity; remove the clip")
        return torch.from_numpy(window) - self.templates[clip.subject]

    def read_audio(self, clip: Clip, start: int, stop: int) -> Tensor:
        """Speech that spans motion frames ``start`` to ``stop``, 16 kHz, filled with zeros past its end."""
        audio = read_speech(self.root / "wav" / f"{clip.name}.wav")
        first = samples_for(start, self.frame_rate)
        return torch.from_numpy(fit_length(audio[first:], samples_for(stop - start, self.frame_rate)))

    def read_mesh(self, file: str) -> Mesh | None:
        """The corpus's mesh file; None if there is no such file."""
        path = self.root / file
        if not path.is_file():
            return None
        mesh = read_mesh(path)
        if len(mesh.vertices) != self.n_vertices:
            raise FaceDiffError(f"{path}: has {len(mesh.vertices)} vertices, expected {self.n_vertices}")
        return mesh

    def read_region(self, file: str, name: str) -> Region:
        """A region file: vertex indices separated by "," or ", "."""
        try:
            return Region.from_file(self.root / "regions" / file, name=name, n_vertices=self.n_vertices)
        except ValueError as error:
            raise FaceDiffError(str(error)) from error

    def read_pairs(self, file: str) -> Tensor | None:
        """Vertex pairs (P, 2), one ``upper, lower`` a line; None if there is no such file."""
        path = self.root / "regions" / file
        if not path.is_file():
            return None
        try:
            with path.open(newline="") as stream:
                pairs = torch.tensor([[int(a), int(b)] for a, b in csv.reader(stream)])
        except ValueError as error:
            raise FaceDiffError(f"{path}: {error}; expected one pair of vertex indices a line") from error
        if pairs.numel() == 0 or int(pairs.min()) < 0 or int(pairs.max()) >= self.n_vertices:
            raise FaceDiffError(f"{path}: expected pairs of vertex indices 0 to {self.n_vertices - 1}")
        return pairs
