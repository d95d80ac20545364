"""A corpus on disk in the layout that circulates in the field, and the readers of its files.

``wav/<clip>.wav``, ``vertices_npy/<clip>.npy`` with (T, 3V) absolute vertices, ``templates.pkl``, ``regions/*.txt``,
a mesh file with the faces, and optionally ``clips.csv`` with further columns per clip and ``manifest.json``.
"""

from __future__ import annotations

import hashlib
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from facediff.data.manifest import LONGEST, refuse_interrupted
from facediff.data.manifest import read_manifest as read_manifest
from facediff.data.recordings import RecordingFolder
from facediff.data.storage import MOTION_FOLDERS as MOTION_FOLDERS
from facediff.data.storage import ChannelFolder, ClipFolder, ClipMotion, ClipStorage, WeightFile
from facediff.errors import FaceDiffError, damaged
from facediff.mesh.alignment import face_size
from facediff.mesh.flame import read_masks
from facediff.mesh.mesh import Mesh
from facediff.mesh.mesh_files import read_mesh
from facediff.metrics import Region
from facediff.spaces import VERTICES, Space
from facediff.speech.audio import samples_for
from facediff.utils.arrays import ArrayStore, read_arrays
from facediff.utils.checksums import sha256
from facediff.utils.files import cache_dir
from facediff.utils.limits import COORDINATE, quoted
from facediff.utils.paths import compose
from facediff.utils.pickles import load_pickle
from facediff.utils.plain_files import read_columns, read_table

LIP_PAIRS, EYELID_PAIRS = "regions/inner_lip_pairs.txt", "regions/eyelid_pairs.txt"
"""Where a corpus lists pairs of an upper and a lower vertex of the inner lips, and of the eyelids."""
LIP_TEETH_PAIRS = "regions/lip_teeth_pairs.txt"
"""The same of the lower lip and the upper teeth's edge, which touch for f and v."""

ALL = "all"
"""The region source that stands for every vertex."""

FLAME_SOURCES: dict[str, tuple[str, ...]] = {
    "lips": ("regions/lve.txt", "FLAME_masks.pkl:lips", "regions/FLAME_masks.pkl:lips", "regions/lip.txt"),
    "upper_face": (
        "regions/fdd.txt",
        "FLAME_masks.pkl:forehead+eye_region",
        "regions/FLAME_masks.pkl:forehead+eye_region",
    ),
}
"""Files that list which of FLAME's vertices are the lips and the upper face, in order of preference."""


@dataclass(frozen=True)
class Circulating:
    """Facts about the copies of a corpus that circulate, by which ``facediff data check`` compares a folder."""

    counts: tuple[str, int, int] | None = None  # split, clips and frames that published scoring scripts report
    # projects with a templates.pkl in their repository, by the beginning of the file's git blob id
    templates: Mapping[str, str] = field(default_factory=dict)
    unit_area: bool = False  # whether templates have a surface area of one
    incomplete: bool = False  # whether some clips were never recorded


@dataclass(frozen=True)
class Clip:
    """One recording.

    Attributes:
        name: the name of its files.
        identity: who speaks.
        sentence: name of the sentence; clips of one sentence have the same words.
        attributes: further columns of ``clips.csv``, or of the name, e.g. the mood.
        root: the corpus folder that holds its files.
    """

    name: str
    identity: str
    sentence: str
    attributes: dict[str, str] = field(default_factory=dict, hash=False)
    root: Path = field(default=Path(), repr=False, compare=False)

    @property
    def number(self) -> int:
        """The sentence's number: the last two characters, as in every project of the field; −1 if it has none."""
        return int(self.sentence[-2:]) if self.sentence[-2:].isdecimal() else -1

    def fits(self, patterns: Mapping[str, str]) -> bool:
        """Whether its attributes fit patterns such as ``{"voice": "flite:*"}``, all of them."""
        return all(fnmatchcase(self.attributes.get(name, ""), pattern) for name, pattern in patterns.items())

    @property
    def words(self) -> str:
        """The words of the column ``text`` of ``clips.csv`` if there is one, else the sentence's name."""
        tokens = re.findall(r"[^\W_]+", self.attributes.get("text", "").casefold())
        return " ".join(tokens) or self.sentence


NameParser = Callable[[str], Clip | None]
"""Finds identity and sentence in a clip's name; None for a file that is no clip of the corpus."""


def parse_name(name: str) -> Clip:
    """``<identity>_<sentence>``, split at the last underscore."""
    identity, _, sentence = name.rpartition("_")
    return Clip(name, identity, sentence)


class Corpus:
    """Read access to a corpus: a folder, or a packed corpus. Only the templates are kept in memory.

    Args:
        root: the folder; of a packed corpus the one that holds its small files.
        n_vertices: vertices of its meshes.
        frame_rate: frames per second of the motion that is returned.
        stored_frame_rate: frames per second of the motion on disk, a whole multiple of ``frame_rate``, of which every
            second (third …) frame is read; ``manifest.json`` overrides it.
        parse: finds identity and sentence in a clip's name.
        people: folders of further speakers with the same topology, as ``facediff data import-person`` writes them.
        storage: where motion and speech of the clips lie; the folder itself if None.
        space: meaning of the motion's numbers; ``n_vertices`` counts its channels where they are no vertices.
    """

    def __init__(
        self,
        root: Path,
        n_vertices: int,
        frame_rate: float,
        *,
        stored_frame_rate: float | None = None,
        parse: NameParser = parse_name,
        people: Sequence[Path] = (),
        storage: ClipStorage | None = None,
        space: Space = VERTICES,
    ) -> None:
        self.root = root
        self.n_vertices = n_vertices
        self.space = space
        self.dims = space.dims
        self.frame_rate = frame_rate
        self.parse = parse
        self.people = list(people)
        self.store = ArrayStore(cache_dir() / "speech")
        if odd := [folder for folder in people if (folder / "vertices_npy").is_dir() != space.is_vertices]:
            expected = "vertices (import-person)" if space.is_vertices else "channels (import-take)"
            raise FaceDiffError(
                f"{odd[0]}: expected a speaker's motion in {expected}, as the corpus in {root} has; give another folder"
            )
        # An imported speaker in channels is a recording as it came, with its own order of channels.
        self._storages: dict[Path, ClipStorage] = {
            folder: ClipFolder(folder, n_vertices) if space.is_vertices else RecordingFolder(folder, space, frame_rate)
            for folder in people
        }
        self._storages[root] = storage or (
            ClipFolder(root, n_vertices) if space.is_vertices else ChannelFolder(root, space)
        )
        stored = stored_frame_rate or frame_rate
        self._strides = {folder: self._stride(folder, stored) for folder in (root, *people)}
        self._frames: dict[str, int] = {}

    def _stride(self, root: Path, default: float) -> int:
        refuse_interrupted(root)
        stored = float(read_manifest(root).get("frame_rate") or default)
        stride = round(stored / self.frame_rate)
        if stride < 1 or abs(stride * self.frame_rate - stored) > 1e-6:
            raise FaceDiffError(
                f"{root / 'manifest.json'}: frame_rate is {stored:g}, expected a whole multiple of the corpus's "
                f"{self.frame_rate:g} frames per second; prepare the folder again with that frame rate"
            )
        return stride

    @cached_property
    def clips(self) -> dict[str, Clip]:
        """Every clip that has both speech and motion, by name, sorted; imported speakers' clips come last."""
        clips = self._clips_of(self.root, self.parse)
        if not clips:
            raise FaceDiffError(f"{self.root}: no clip found; expected wav/<clip>.wav with vertices_npy/<clip>.npy")
        for person in self.people:
            clips |= self._clips_of(person, parse_name)
        return clips

    def _clips_of(self, root: Path, parse: NameParser) -> dict[str, Clip]:
        rows = read_clip_table(root)
        clips = {}
        for name in self._storages[root].names():
            clip = parse(name)
            if clip is not None:
                attributes = {**rows.get(name, {}), **clip.attributes}
                clips[name] = Clip(name, clip.identity, clip.sentence, attributes, root)
        return clips

    @cached_property
    def templates(self) -> dict[str, Tensor]:
        """Neutral face (V, 3) of every identity, float32; of channels their resting values (C, 1), which are zero."""
        if not self.space.is_vertices:
            return {clip.identity: torch.zeros(self.n_vertices, 1) for clip in self.clips.values()}
        templates = read_templates(self.root / "templates.pkl", self.n_vertices)
        for root in self.people:
            faces = read_templates(root / "templates.pkl", self.n_vertices)
            if name := next(iter(faces.keys() & templates.keys()), None):
                raise FaceDiffError(f"{root}: {self.root} has a {name} already; import the speaker under a new name")
            person, other = (face_size(next(iter(group.values())).numpy()) for group in (faces, templates))
            if not 0.5 < person / other < 2:
                raise FaceDiffError(f"{root}: {person / other:.3g} times as large as {self.root}'s faces; import again")
            templates |= faces
        return templates

    def template(self, clip: Clip) -> Tensor:
        """Neutral face (V, dims) of a clip's speaker."""
        if clip.identity not in self.templates:
            raise FaceDiffError(
                f"{clip.root / 'templates.pkl'}: no template for {clip.identity}, needed by clip {clip.name}; "
                f"it has {', '.join(sorted(self.templates))}"
            )
        return self.templates[clip.identity]

    def frames(self, clip: Clip) -> int:
        """Number of motion frames of a clip at the corpus's frame rate; looked up once."""
        if clip.name not in self._frames:
            self._open(clip)
        return self._frames[clip.name]

    def _open(self, clip: Clip) -> ClipMotion:
        opened = self._storages[clip.root].open(clip.name)
        self._frames[clip.name] = -(-opened.frames // self._strides[clip.root])
        return opened

    def read_motion(self, clip: Clip, start: int = 0, stop: int | None = None) -> Tensor:
        """Offsets from the template (T, V, dims), float32; only frames ``start`` to ``stop`` are read."""
        opened, stride = self._open(clip), self._strides[clip.root]
        numbers = range(self._frames[clip.name])[start:stop]
        picks = range(numbers.start * stride, numbers.stop * stride, stride)
        return torch.from_numpy(opened.offsets(picks, self.template(clip).numpy()))

    def mean_motion(self, clip: Clip) -> Tensor:
        """Mean offset from the template over all frames (V, dims), float64."""
        opened = self._open(clip)
        if not isinstance(opened, WeightFile):
            return self.read_motion(clip).mean(0, dtype=torch.float64)
        # Decoding is linear, so the mean of the weights gives the mean face, for one frame's work.
        mean = opened.checked(self._all_frames(clip)).mean(0, dtype=np.float64)
        return torch.from_numpy(opened.decode(mean[None].astype(np.float32))[0] - self.template(clip).numpy()).double()

    def read_projected(
        self, clip: Clip, project: Callable[[Tensor], Tensor], shapes_by_speaker: dict[str, Tensor]
    ) -> Tensor:
        """An affine function of each frame of a clip, (T, K).

        Args:
            clip: the clip.
            project: takes offsets from the template (T, V, dims) to (T, K).
            shapes_by_speaker: values of the function for the shapes of speakers; filled here.
        """
        opened = self._open(clip)
        if not isinstance(opened, WeightFile):
            return project(self.read_motion(clip))
        # Decoding is linear too: weights meet the function of 54 shapes, instead of the function meeting each frame.
        if clip.identity not in shapes_by_speaker:
            shapes = torch.from_numpy(np.array(opened.rig, np.float32))
            shapes[0] -= self.template(clip)
            images = project(torch.cat([torch.zeros_like(shapes[:1]), shapes]))
            shapes_by_speaker[clip.identity] = torch.cat([images[1:2], images[2:] - images[:1]])
        images = shapes_by_speaker[clip.identity]
        return torch.from_numpy(opened.checked(self._all_frames(clip))) @ images[1:] + images[0]

    @property
    def stride(self) -> int:
        """How many stored frames of the corpus's own folder there are for each that is read."""
        return self._strides[self.root]

    def _all_frames(self, clip: Clip) -> range:
        """The stored frames of a clip that are read of it as a whole."""
        stride = self._strides[clip.root]
        return range(0, self.frames(clip) * stride, stride)

    def read_spread(self, clip: Clip, count: int, phase: float | None = None) -> Tensor:
        """Offsets from the template (at most ``count``, V, dims), float32, of evenly spread frames.

        The clip is opened once.

        Args:
            clip: the clip.
            count: frames.
            phase: the clip is cut into as many equal parts, and this is the place in each of them, from 0 to below 1;
                None takes the first frame, the last one and those between.
        """
        opened, stride = self._open(clip), self._strides[clip.root]
        frames = self._frames[clip.name]
        count = min(frames, count)
        numbers = torch.linspace(0, frames - 1, count)
        if phase is not None:
            numbers = (torch.arange(count) + phase) * (frames / count)
        picks = [number * stride for number in numbers.long().tolist()]
        return torch.from_numpy(opened.offsets(picks, self.template(clip).numpy()))

    def read_audio(self, clip: Clip, start: int, stop: int) -> Tensor:
        """Speech that spans motion frames ``start`` to ``stop``, 16 kHz, filled with zeros past its end."""
        first = samples_for(start, self.frame_rate)
        length = samples_for(stop - start, self.frame_rate)
        return torch.from_numpy(self._storages[clip.root].speech(clip.name, first, length, self.store))

    def fingerprint(self, clips: Sequence[Clip]) -> str:
        """A hash that changes when the motion of these clips, or a template, changes; only small files are opened.

        It is made of each folder's ``manifest.json``, which holds the checksums of a prepared corpus, and, since not
        every folder has one, of the sizes and times of its files.
        """
        parts: list[object] = [clip.name for clip in clips]
        for root in sorted({clip.root for clip in clips}):
            manifest = root / "manifest.json"
            parts += [sha256(manifest) if manifest.is_file() else "", self._strides[root]]
            parts += [sha256(root / "templates.pkl") if self.space.is_vertices else self.space]
            parts += [self._storages[root].version(clip.name) for clip in clips if clip.root == root]
        return hashlib.sha256("\0".join(map(str, parts)).encode()).hexdigest()

    def read_mesh(self, files: Sequence[str]) -> Mesh | None:
        """The first mesh file that exists, in the folder itself or in ``templates/``; None if there is none."""
        paths = [folder / file for file in files for folder in (self.root, self.root / "templates")]
        path = next(filter(Path.is_file, paths), None)
        if path is None:
            return None
        mesh = read_mesh(path)
        if len(mesh.vertices) != self.n_vertices:
            raise FaceDiffError(f"{path}: has {len(mesh.vertices)} vertices, expected {self.n_vertices}")
        return mesh

    def read_colours(self) -> dict[str, Tensor]:
        """Colours (V, 3) from 0 to 255 of speakers who have their own, from ``colours.npz``; empty without the file."""
        path = self.root / "colours.npz"
        arrays = read_arrays(path) if path.is_file() else {}
        return {name: torch.from_numpy(array) for name, array in arrays.items() if name in self.templates}

    def read_pairs(self, file: str) -> Tensor | None:
        """Vertex pairs (P, 2), one ``upper, lower`` or ``upper lower`` a line of a file; None if it does not exist."""
        path = self.root / file
        if not path.is_file():
            return None
        remedy = "expected one pair of vertex indices a line, such as 12, 34"
        rows: list[tuple[int, int]] = []
        for number, row in enumerate(read_table(path, remedy=remedy), 1):
            pair = " ".join(row).split()
            if len(pair) != 2 or not all(word.isdecimal() and int(word) < self.n_vertices for word in pair):
                raise FaceDiffError(f"{path}: row {number} is {', '.join(row)!r}; {remedy}, below {self.n_vertices}")
            rows.append((int(pair[0]), int(pair[1])))
        return torch.tensor(rows, dtype=torch.long).view(-1, 2)


# The readers, one for each kind of file; motion and speech are read by facediff.data.storage.


def read_templates(path: Path, n_vertices: int | None = None) -> dict[str, Tensor]:
    """``templates.pkl``: the neutral face (V, 3) of each identity, float32.

    Args:
        path: the file.
        n_vertices: vertices of the mesh; as many as the first face has if None.
    """
    loaded = load_template_dict(path)
    if n_vertices is None:
        n_vertices = np.size(next(iter(loaded.values()), ())) // 3
    faces = [(name, as_template(path, name, value, n_vertices)) for name, value in loaded.items()]
    return {compose(name): torch.from_numpy(face) for name, face in faces}


def load_template_dict(path: Path) -> dict[Any, Any]:
    """The dict in ``templates.pkl``; :func:`as_template` checks its entries."""
    loaded = load_pickle(path)
    if not isinstance(loaded, dict) or not loaded:
        raise FaceDiffError(f"{path}: holds {quoted(loaded)}; expected a dict from identity to (V, 3) array")
    return loaded


def as_template(
    path: object, name: object, value: object, n_vertices: int, dtype: npt.DTypeLike = np.float32
) -> npt.NDArray[Any]:
    """One entry of ``templates.pkl`` as a neutral face (V, 3)."""
    try:
        entry = np.asarray(value)
    except (TypeError, ValueError, OverflowError):  # lists of unequal length
        entry = np.array(None)
    with np.errstate(all="ignore"):  # what float32 cannot hold becomes infinite, and is refused as such
        array = np.array(entry, dtype) if entry.dtype.kind == "f" else np.empty(0, dtype)
    beyond = np.count_nonzero(~(np.abs(array) <= COORDINATE))
    has_name = isinstance(name, str) and name.isprintable() and 0 < len(name) <= LONGEST
    if not has_name or array.shape not in ((3 * n_vertices,), (n_vertices, 3)) or beyond:
        raise FaceDiffError(
            f"{path}: the template of {quoted(name)} is {entry.dtype} {entry.shape} with {beyond} coordinates that are "
            f"NaN or beyond {COORDINATE:g}; expected finite floating-point numbers, ({n_vertices}, 3)"
        )
    return array.reshape(n_vertices, 3)


CLIP_COLUMNS = ("clip", "subject", "sentence", "split", "mood", "emotion", "intensity", "voice", "text")
"""Columns of ``clips.csv`` that mean something; other columns are attributes of one's own."""


def read_clip_table(root: Path) -> dict[str, dict[str, str]]:
    """``clips.csv`` of a folder: the further columns of each clip; empty if there is none."""
    path = root / "clips.csv"
    if not path.is_file():
        return {}
    remedy = "save it as CSV UTF-8, with one row a clip"
    header, rows = read_columns(path, CLIP_COLUMNS, remedy=remedy)
    table: dict[str, dict[str, str]] = {}
    for number, cells in enumerate(rows, 2):
        row = {key: compose(cell) for key, cell in zip(header, cells, strict=False) if key}
        fits = len(cells) >= len(header) and not any(cells[len(header) :])
        if not fits or not all(map(str.isprintable, row.values())) or row.get("clip") in (None, *table):
            raise FaceDiffError(
                f"{path}: row {number} is {quoted(cells)}; expected {len(header)} printable cells with the column "
                f"clip, which names another clip in each row; {remedy}"
            )
        table[row.pop("clip")] = row
    return table


def find_region(root: Path, sources: Sequence[str], name: str, n_vertices: int, help_text: str = "") -> Region:
    """The region of the first source with a file.

    A source is a file below ``root``: a text file of indices separated by "," or ", "; a pickle with a list of indices;
    or ``FLAME_masks.pkl:lips``, one or several (joined by "+") masks of a pickle with named masks. ``all`` is every
    vertex.
    """
    for source in sources:
        if source == ALL:
            return Region.from_indices("all vertices", range(n_vertices), n_vertices=n_vertices)
        file, _, masks = source.partition(":")
        path = root / file
        if not path.is_file():
            continue
        with damaged(path, "get the file again"):
            if path.suffix == ".pkl":
                return Region.from_indices(name, read_masks(path, masks), n_vertices=n_vertices)
            return Region.from_file(path, name=name, n_vertices=n_vertices)
    paths = ", ".join(str(root / source) for source in sources)
    raise FaceDiffError(
        f"{root}: no file lists the vertices of the {name.replace('_', ' ')}; looked for {paths}. {help_text} "
        f"To train and score on all vertices instead, set data.{name}={ALL}"
    )
