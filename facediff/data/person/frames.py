"""A folder with one mesh file a frame: in which order, what is missing, and reading it."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import MOTION_FOLDERS, read_manifest, read_templates
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh, Similarity, face_size, read_mesh, robust_align
from facediff.utils.progress import track

# Arrays on disk that are needed while importing only.


def scratch_array(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """A new memory-mapped float32 array."""
    array: npt.NDArray[np.float32] = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
    return array


# Reading the meshes of single frames: vertices in the order of the file, and which triangles they form.

Faces = npt.NDArray[np.integer]

MESHES = (".obj", ".ply")


def differing_faces(one: Faces, other: Faces) -> int:
    """How many triangles two lists do not share; order of triangles and of their corners does not count."""
    first, second = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (one, other))
    _, counts = np.unique(np.concatenate([first, second]), axis=0, return_counts=True)
    return int(np.count_nonzero(counts == 1))


# The corpus that a person is to join: what its topology, coordinates and frame rate are.

Array = npt.NDArray[np.float64]

RESIDUAL_LIMIT = 0.15
"""Largest residual of a face laid onto the corpus's mean face, as a share of its size (root mean squares).

Faces of different people differ by some hundredths; vertices in another order by about 1.
"""
SAME_UNIT = 1.2
"""A person's face and the corpus's mean face differ in size by less than this factor."""


@dataclass(frozen=True)
class Auxiliary:
    """A corpus, as far as a extra_identity must fit it.

    Attributes:
        root: its folder.
        mean: (V, 3) mean of its templates.
        faces: (F, 3) triangles; None if it has no mesh file.
        frame_rate: motion frames a second.
        unit: unit of length, as its manifest says; None if it does not.
    """

    root: Path
    mean: Array
    faces: Faces | None
    frame_rate: float
    unit: str | None

    @property
    def n_vertices(self) -> int:
        """Vertices of its topology."""
        return len(self.mean)


def read_auxiliary(root: Path, *, name: str, frame_rate: float | None) -> Auxiliary:
    """Read what a person must fit.

    Args:
        root: the corpus folder.
        name: the person's name, which must be new to the corpus.
        frame_rate: the corpus's frame rate, needed where ``manifest.json`` does not tell it.

    Raises:
        FaceDiffError: if the folder is no corpus, knows the name already, or its frame rate is unknown or contradicted.
    """
    if not root.is_dir():
        raise FaceDiffError(f"--corpus {root}: no such folder; expected one with wav/, vertices_npy/ and templates.pkl")
    templates = read_templates(root / "templates.pkl")
    stems = {path.stem for folder in MOTION_FOLDERS for path in (root / folder).glob("*.npy")}
    subjects = {*templates, *(stem.rpartition("_")[0] for stem in stems)}
    if name.casefold() in {subject.casefold() for subject in subjects}:
        raise FaceDiffError(
            f"--name {name}: {root} has a person of that name already; no clip of the new person may be in it"
        )
    manifest = read_manifest(root)
    unit = manifest.get("unit")
    mean: Array = np.stack([template.numpy() for template in templates.values()]).astype(np.float64).mean(axis=0)
    return Auxiliary(
        root,
        mean,
        _corpus_faces(root, len(mean)),
        _frame_rate(root, manifest.get("frame_rate"), frame_rate),
        unit if isinstance(unit, str) else None,
    )


def _frame_rate(root: Path, told: object, given: float | None) -> float:
    known = float(told) if isinstance(told, int | float) and math.isfinite(told) and told > 0 else None
    if known is None and given is None:
        raise FaceDiffError(f"{root}: has no manifest.json that tells its frame rate; add --corpus-frame-rate")
    if known is not None and given is not None and abs(known - given) > 1e-6:
        raise FaceDiffError(
            f"--corpus-frame-rate {given:g}: {root / 'manifest.json'} says {known:g}; leave the option away"
        )
    return known if known is not None else float(given or 0)


def _corpus_faces(root: Path, n_vertices: int) -> Faces | None:
    """Faces of the first mesh in the folder or in ``templates/`` that has the right vertex count."""
    for folder in (root, root / "templates"):
        for path in sorted(folder.glob("*")):
            if path.suffix.lower() in MESHES and path.is_file():
                mesh = read_mesh(path, points_allowed=True)
                if len(mesh.vertices) == n_vertices and len(mesh.faces):
                    return mesh.faces
    return None


def check_faces(path: Path, faces: Faces | None, corpus: Auxiliary) -> bool:
    """Whether faces could be compared with the corpus's.

    Raises:
        FaceDiffError: if they could, and are others.
    """
    if faces is None or corpus.faces is None:
        return False
    differing = differing_faces(faces, corpus.faces)
    if differing:
        raise FaceDiffError(
            f"{path}: {differing} triangles are not those of the mesh in {corpus.root}, so the topology is another; if "
            f"only polygons were cut otherwise, give the motion as a .npy array, which has no faces"
        )
    return True


def lay_onto_corpus(path: Path, face: Array, corpus: Auxiliary) -> tuple[Similarity, float]:
    """The similarity from a face to the corpus's mean face, and what is left as a share of the face's size.

    Raises:
        FaceDiffError: naming ``path``, if so much is left that the vertices cannot be in the corpus's order.
    """
    map_ = robust_align(face, corpus.mean, scale=True)
    residual = relative_residual(map_.apply(face), corpus.mean)
    if not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{path}: its face does not lie on those of {corpus.root} (residual {residual:.2f} of its size, expected "
            f"less than {RESIDUAL_LIMIT}), so the order of its vertices or the topology is another, or it is mirrored"
        )
    return map_, residual


def relative_residual(face: Array, target: Array) -> float:
    """Root-mean-square distance of two faces (V, 3), as a share of the target's size."""
    return float(np.sqrt(np.square(face - target).sum(axis=-1).mean())) / face_size(target)


def into_coordinates(face: Array, best: Similarity, given: float | None) -> Similarity:
    """The one similarity that takes a person into the corpus's coordinates.

    Its scale changes the unit and leaves the person's size alone: where the measured scale is near a power of ten
    (millimetres, centimetres, metres), it is that power; else, as with a corpus of normalised size, it is as measured.

    Args:
        face: (V, 3) the person's neutral face.
        best: the similarity that lays it onto the corpus's mean face best; kept but for its scale, about the face's
            centre.
        given: the scale to use instead.
    """
    power = round(math.log10(best.scale))
    is_unit = abs(math.log10(best.scale) - power) < math.log10(SAME_UNIT)
    scale = given if given is not None else 10.0**power if is_unit else best.scale
    centre = face.mean(axis=0)
    return Similarity(best.rotation, best.apply(centre) - scale * best.rotation @ centre, scale)


MAX_GAP = 0.2
"""Longest stretch of missing frames that is filled, in seconds."""


@dataclass(frozen=True)
class FrameFiles:
    """The files of a folder in order.

    Attributes:
        paths: one for each frame that is there.
        places: its place in time, from 0; a place that is skipped is a missing frame.
        numbers: its number in the file's name.
    """

    paths: list[Path]
    places: list[int]
    numbers: list[int]

    @property
    def frames(self) -> int:
        """Number of frames, those that are missing included."""
        return self.places[-1] + 1

    def missing(self) -> list[tuple[int, int]]:
        """Stretches of missing frames: place of the last frame before, and of the first one after."""
        return [(a, b) for a, b in zip(self.places, self.places[1:], strict=False) if b - a > 1]


def find_frames(folder: Path) -> FrameFiles:
    """The mesh files of a folder, in the natural order of the one number that tells them apart.

    Raises:
        FaceDiffError: if there is none, if names differ in more than that number, or if two have the same number.
    """
    try:
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in MESHES and not p.name.startswith("."))
    except OSError as error:
        raise FaceDiffError(f"{folder}: cannot be read ({error.strerror}); check its permissions") from error
    if not paths:
        raise FaceDiffError(f"{folder}: holds no mesh files; expected one a frame, {' or '.join(MESHES)}")
    pieces = [re.split(r"(\d+)", path.stem) for path in paths]
    for path, piece in zip(paths, pieces, strict=True):
        if piece[::2] != pieces[0][::2] or len(piece) == 1:
            raise FaceDiffError(
                f"{folder}: {paths[0].name} and {path.name} are named in different ways; "
                f"leave only one file a frame in the folder, named like frame_0001.obj"
            )
    figures = np.array([[int(word) for word in piece[1::2]] for piece in pieces], dtype=object)
    varying = [column for column in range(figures.shape[1]) if len(set(figures[:, column])) > 1]
    if len(varying) > 1:
        raise FaceDiffError(
            f"{folder}: the names differ in more than one number ({paths[0].name}, {paths[-1].name}); expected the "
            f"frames of one video, told apart by the number of the frame"
        )
    column = varying[0] if varying else figures.shape[1] - 1
    order = sorted(range(len(paths)), key=lambda i: figures[i, column])
    paths, numbers = [paths[i] for i in order], [int(figures[i, column]) for i in order]
    for i in range(1, len(paths)):
        if numbers[i] == numbers[i - 1]:
            raise FaceDiffError(
                f"{folder}: {paths[i - 1].name} and {paths[i].name} are both frame {numbers[i]}; remove one of them"
            )
    return FrameFiles(paths, _places(numbers), numbers)


def _places(numbers: list[int]) -> list[int]:
    """Numbers from 0; a tool that took every second frame of a video and numbers them so has left out none."""
    steps = {b - a for a, b in zip(numbers, numbers[1:], strict=False)}
    step = min(steps, default=1)
    step = step if all(other % step == 0 for other in steps) else 1
    return [(number - numbers[0]) // step for number in numbers]


def read_frames(
    folder: Path, *, n_vertices: int, frame_rate: float, scratch: Path, progress: bool = False
) -> tuple[npt.NDArray[np.float32], Faces | None, list[str]]:
    """Read the mesh files of a folder into a memory-mapped array.

    A few missing frames (a tracker that lost the face) are filled by straight lines between their neighbours.

    Args:
        folder: the folder.
        n_vertices: vertices that every mesh must have.
        frame_rate: frames a second, to tell how long a gap is.
        scratch: a file to make for the array.
        progress: whether to show a progress bar.

    Returns:
        vertices (T, V, 3), the faces that all files share (None if they have none), and remarks for the user.

    Raises:
        FaceDiffError: naming the file, if one is unreadable or its topology another; if too many frames are missing.
    """
    files = find_frames(folder)
    gaps = files.missing()
    for before, after in gaps:
        if after - before - 1 > MAX_GAP * frame_rate:
            here = files.places.index(before)
            raise FaceDiffError(
                f"{folder}: {after - before - 1} frames are missing between {files.paths[here].name} and "
                f"{files.paths[here + 1].name}; at most {MAX_GAP} s can be filled, so cut the video there"
            )
    frames = scratch_array(scratch, (files.frames, n_vertices, 3))
    first: Mesh | None = None
    for path, place in zip(track(files.paths, "reading meshes", shown=progress), files.places, strict=True):
        mesh = read_mesh(path, points_allowed=True)
        first = first or mesh
        _check(path, mesh, files.paths[0], first, n_vertices)
        frames[place] = mesh.vertices
    for before, after in gaps:
        for place in range(before + 1, after):
            share = (place - before) / (after - before)
            frames[place] = (1 - share) * frames[before] + share * frames[after]
    filled = [place for before, after in gaps for place in range(before + 1, after)]
    notes = [f"{len(filled)} missing frames filled from their neighbours: {spans(filled)}"] if filled else []
    if files.numbers[-1] - files.numbers[0] > files.places[-1]:
        notes.append("the files' numbers go up in equal steps of more than one; taken as consecutive frames")
    return frames, first.faces if first is not None and len(first.faces) else None, notes


def _check(path: Path, mesh: Mesh, first_path: Path, first: Mesh, n_vertices: int) -> None:
    count = len(mesh.vertices)
    if count != len(first.vertices):
        raise FaceDiffError(
            f"{path}: has {count} vertices, but {first_path.name} has {len(first.vertices)}; expected one topology"
        )
    if count != n_vertices:
        raise FaceDiffError(f"{path}: has {count} vertices, but the corpus has {n_vertices}; its topology is another")
    if not np.isfinite(mesh.vertices).all():
        raise FaceDiffError(f"{path}: holds NaN or infinity; repair the frame, or remove the file")
    if not np.array_equal(mesh.faces, first.faces) and differing_faces(mesh.faces, first.faces):
        raise FaceDiffError(f"{path}: its faces differ from those of {first_path.name}; expected one topology")


def spans(places: list[int], most: int = 10) -> str:
    """Sorted whole numbers in short: ``3-7, 12``; an ellipsis after ``most`` spans.

    >>> spans([3, 4, 5, 12])
    '3-5, 12'
    """
    parts: list[list[int]] = []
    for place in places:
        if parts and place == parts[-1][1] + 1:
            parts[-1][1] = place
        else:
            parts.append([place, place])
    words = [str(a) if a == b else f"{a}-{b}" for a, b in parts]
    return ", ".join(words if len(words) <= most else [*words[:most], "…"])
