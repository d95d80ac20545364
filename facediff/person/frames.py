"""A folder with one mesh file a frame: in which order, what is missing, and reading it."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.person.meshes import MESHES, Faces, FrameMesh, differing_faces, read_frame_mesh
from facediff.person.scratch import scratch_array

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
    first: FrameMesh | None = None
    for path, place in zip(_bar(files.paths, progress), files.places, strict=True):
        mesh = read_frame_mesh(path, known=first)
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
    return frames, None if first is None else first.faces, notes


def _check(path: Path, mesh: FrameMesh, first_path: Path, first: FrameMesh, n_vertices: int) -> None:
    count = len(mesh.vertices)
    if count != len(first.vertices):
        raise FaceDiffError(
            f"{path}: has {count} vertices, but {first_path.name} has {len(first.vertices)}; expected one topology"
        )
    if count != n_vertices:
        raise FaceDiffError(f"{path}: has {count} vertices, but the corpus has {n_vertices}; its topology is another")
    if not np.isfinite(mesh.vertices).all():
        raise FaceDiffError(f"{path}: holds NaN or infinity; repair the frame, or remove the file")
    if mesh.faces is first.faces:
        return
    if mesh.faces is None or first.faces is None or differing_faces(mesh.faces, first.faces):
        raise FaceDiffError(f"{path}: its faces differ from those of {first_path.name}; expected one topology")


def _bar(paths: list[Path], progress: bool) -> Iterable[Path]:
    if not progress:
        return paths
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise MissingExtraError("tqdm", "prepare", "the progress bar") from error
    return tqdm(paths, desc="reading meshes", unit="frame", leave=False)


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
