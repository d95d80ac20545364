"""A speaker's motion in any of the forms that reconstruction tools write: meshes, vertices, FLAME parameters."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.reconstructions import read_parameters
from facediff.errors import FaceDiffError
from facediff.mesh import Mesh, read_mesh
from facediff.mesh.flame import Flame
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.files import reserve_room
from facediff.utils.hdf5 import HDF5_SUFFIXES
from facediff.utils.progress import track

Array = npt.NDArray[np.float64]
Faces = npt.NDArray[np.integer]

MESHES = (".obj", ".ply")
MAX_GAP = 0.2  # longest stretch of missing frames that is filled, in seconds
FLAME_FRAMES = 64  # frames that the FLAME layer works on at a time


@dataclass(frozen=True)
class FaceSequence:
    """A sequence of faces as read."""

    frames: npt.NDArray[np.floating]  # (T, V, 3), usually memory-mapped
    faces: Faces | None = None  # (F, 3) triangles
    template: npt.NDArray[np.float64] | None = None  # (V, 3) neutral face, where the source has one
    has_head_motion: bool = True
    notes: list[str] = field(default_factory=list)  # for the user


def read_motion(
    path: Path, *, n_vertices: int, frame_rate: float, scratch: Path, flame: Path | None = None, progress: bool = False
) -> FaceSequence:
    """Read a folder of OBJ or PLY files, a .npy array of vertices, or FLAME parameters.

    ``flame`` is the FLAME model file, needed for parameters and only for them; ``scratch`` is a temporary file for
    frames that must be put together.
    """
    if flame is not None:
        return _read_flame(path, flame, n_vertices, scratch)
    if path.is_dir():
        frames, faces, notes = read_frames(
            path, n_vertices=n_vertices, frame_rate=frame_rate, scratch=scratch, progress=progress
        )
        return FaceSequence(frames, faces, notes=notes)
    array = np.empty(0) if path.suffix.lower() in HDF5_SUFFIXES else open_array(path, kinds="f")
    if vertices_of(array.shape) != n_vertices:
        raise FaceDiffError(
            f"{path}: has shape {array.shape}; expected (frames, {n_vertices}, 3) or (frames, {3 * n_vertices}) like "
            f"the corpus, a folder of .obj or .ply files, or FLAME parameters with --flame MODEL"
        )
    return FaceSequence(array.reshape(len(array), n_vertices, 3))


def _read_flame(path: Path, model: Path, n_vertices: int, scratch: Path) -> FaceSequence:
    """Vertices of FLAME parameters without head pose; the neutral face is the shape without expression."""
    parameters, layer = read_parameters(path), Flame.read(model)
    shape, expression, jaw = parameters.shape, parameters.expression, parameters.jaw
    template = layer.shaped(shape)
    if len(template) != n_vertices:
        raise FaceDiffError(
            f"{model}: has {len(template)} vertices, but the corpus has {n_vertices}; so its topology is not FLAME"
        )
    frames = scratch_array(scratch, (len(expression), n_vertices, 3))
    for first in range(0, len(expression), FLAME_FRAMES):
        part = slice(first, first + FLAME_FRAMES)
        frames[part] = layer.vertices(shape, expression[part], jaw[part])
    faces = np.asarray(layer.faces, np.int64)
    return FaceSequence(frames, faces, np.asarray(template, np.float64), has_head_motion=False)


# A folder with one mesh file for each frame.


def read_frames(
    folder: Path, *, n_vertices: int, frame_rate: float, scratch: Path, progress: bool = False
) -> tuple[npt.NDArray[np.float32], Faces | None, list[str]]:
    """Read the mesh files of a folder into a memory-mapped array.

    A few missing frames (a tracker that lost the face) are filled by straight lines between their neighbours.

    Returns:
        vertices (T, V, 3), the faces that all files share (None if they have none), and remarks for the user.
    """
    files = find_frames(folder)
    gaps = files.missing()
    for before, after in gaps:
        if after - before - 1 > MAX_GAP * frame_rate:
            index = files.frames.index(before)
            raise FaceDiffError(
                f"{folder}: {after - before - 1} frames are missing between {files.paths[index].name} and "
                f"{files.paths[index + 1].name}; at most {MAX_GAP} s can be filled, so cut the video there"
            )
    frames = scratch_array(scratch, (files.frames[-1] + 1, n_vertices, 3))
    first: Mesh | None = None
    for path, frame in zip(track(files.paths, "reading meshes", shown=progress), files.frames, strict=True):
        mesh = read_mesh(path, points_allowed=True)
        first = first or mesh
        same = np.array_equal(mesh.faces, first.faces) or not differing_faces(mesh.faces, first.faces)
        if not same or len(mesh.vertices) != n_vertices or not np.isfinite(mesh.vertices).all():
            raise FaceDiffError(
                f"{path}: has {len(mesh.vertices)} vertices, NaN among them, or other faces than "
                f"{files.paths[0].name}; expected {n_vertices} finite ones in one topology, as the corpus has"
            )
        frames[frame] = mesh.vertices
    for before, after in gaps:
        for frame in range(before + 1, after):
            share = (frame - before) / (after - before)
            frames[frame] = (1 - share) * frames[before] + share * frames[after]
    filled = [frame for before, after in gaps for frame in range(before + 1, after)]
    notes = [f"{len(filled)} missing frames filled from their neighbours: {spans(filled)}"] if filled else []
    if files.numbers[-1] - files.numbers[0] > files.frames[-1]:
        notes.append("the files' numbers go up in equal steps of more than one; they are read as consecutive frames")
    return frames, first.faces if first is not None and len(first.faces) else None, notes


@dataclass(frozen=True)
class FrameFiles:
    """The files of a folder in order, their numbers, and their frames from 0, of which some may be missing."""

    paths: list[Path]
    frames: list[int]
    numbers: list[int]

    def missing(self) -> list[tuple[int, int]]:
        """Stretches of missing frames: the last frame before, and the first one after."""
        return [(a, b) for a, b in zip(self.frames, self.frames[1:], strict=False) if b - a > 1]


def find_frames(folder: Path) -> FrameFiles:
    """The mesh files of a folder, in the natural order of the one number in which their names differ."""
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in MESHES and not p.name.startswith("."))
    pieces = [re.split(r"(\d+)", path.stem) for path in paths]
    texts = {tuple(piece[::2]) for piece in pieces}
    figures = np.array([[int(word) for word in piece[1::2]] for piece in pieces if len(texts) == 1], dtype=object)
    varying = [column for column in range(figures.shape[-1]) if len(set(figures[:, column])) > 1] if paths else []
    if len(texts) != 1 or not figures.size or len(varying) > 1 or len(set(map(tuple, figures.tolist()))) < len(paths):
        raise FaceDiffError(
            f"{folder}: expected one {' or '.join(MESHES)} file for each frame, with names that differ in one number, "
            f"such as frame_0001.obj"
        )
    column = varying[0] if varying else figures.shape[1] - 1
    order = sorted(range(len(paths)), key=lambda i: figures[i, column])
    paths, numbers = [paths[i] for i in order], [int(figures[i, column]) for i in order]
    # Equal steps of more than one mean that a tool kept every second (third …) frame, not gaps.
    steps = {b - a for a, b in zip(numbers, numbers[1:], strict=False)}
    step = min(steps, default=1)
    step = step if all(distance % step == 0 for distance in steps) else 1
    return FrameFiles(paths, [(number - numbers[0]) // step for number in numbers], numbers)


def differing_faces(faces: Faces, reference: Faces) -> int:
    """How many triangles two lists do not share; order of triangles and of their corners does not count."""
    first, second = (np.unique(np.sort(triangles, axis=1), axis=0) for triangles in (faces, reference))
    _, counts = np.unique(np.concatenate([first, second]), axis=0, return_counts=True)
    return int(np.count_nonzero(counts == 1))


# Helpers that the other steps of an import use as well.


def scratch_array(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """A new memory-mapped float32 array."""
    array: npt.NDArray[np.float32] = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
    reserve_room(path)
    return array


def spans(numbers: list[int]) -> str:
    """Sorted whole numbers in short: ``3-7, 12``; an ellipsis after ten spans.

    >>> spans([3, 4, 5, 12])
    '3-5, 12'
    """
    parts: list[list[int]] = []
    for number in numbers:
        if parts and number == parts[-1][1] + 1:
            parts[-1][1] = number
        else:
            parts.append([number, number])
    texts = [str(a) if a == b else f"{a}-{b}" for a, b in parts]
    return ", ".join(texts if len(texts) <= 10 else [*texts[:10], "…"])
