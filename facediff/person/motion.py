"""Motion in any of the forms that reconstruction tools write."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.person.frames import read_frames
from facediff.person.meshes import Faces
from facediff.person.scratch import scratch_array
from facediff.prepare.flame_parameters import read_parameters
from facediff.topology.flame import Flame

FLAME_WIDTH = 403
"""Shape 300, expression 100 and jaw 3 in one row."""
FLAME_FRAMES = 64
"""Frames that the FLAME layer works on at a time."""


@dataclass(frozen=True)
class Motion:
    """A sequence of faces as read.

    Attributes:
        frames: (T, V, 3), usually memory-mapped.
        faces: (F, 3) triangles; None if the source does not tell them.
        template: (V, 3) neutral face, where the source tells it.
        has_head_motion: whether the head's rigid motion is in it.
        notes: remarks for the user.
    """

    frames: npt.NDArray[np.floating]
    faces: Faces | None = None
    template: npt.NDArray[np.float64] | None = None
    has_head_motion: bool = True
    notes: list[str] = field(default_factory=list)


def read_motion(
    path: Path, *, n_vertices: int, frame_rate: float, scratch: Path, flame: Path | None = None, progress: bool = False
) -> Motion:
    """Read a folder of OBJ or PLY files, a .npy array of vertices, or FLAME parameters.

    Args:
        path: the folder or file.
        n_vertices: vertices that every frame must have.
        frame_rate: frames a second.
        scratch: a file to make where the frames must be put together.
        flame: FLAME model file, needed for parameters and only for them.
        progress: whether to show a progress bar.

    Raises:
        FaceDiffError: if it is none of these, or damaged.
    """
    parameters = path.suffix.lower() in (".hdf5", ".h5")
    if path.suffix.lower() == ".npy" and path.is_file():
        array = open_array(path)
        vertices = _as_vertices(array, n_vertices)
        if vertices is not None and flame is None:
            return Motion(vertices)
        parameters = array.shape[-1] == FLAME_WIDTH
        if not parameters and vertices is None:
            raise FaceDiffError(
                f"{path}: has shape {array.shape}; expected (frames, {n_vertices}, 3) or (frames, {3 * n_vertices}) "
                f"like the corpus, or FLAME parameters (1, frames, {FLAME_WIDTH})"
            )
    elif path.is_dir():
        if flame is None:
            frames, faces, notes = read_frames(
                path, n_vertices=n_vertices, frame_rate=frame_rate, scratch=scratch, progress=progress
            )
            return Motion(frames, faces, notes=notes)
    elif not path.is_file():
        raise FaceDiffError(f"{path}: no such file or folder; expected the reconstructed motion")
    if not parameters:
        kinds = "a folder of .obj or .ply files, a .npy array, or FLAME parameters (.hdf5 or .npy)"
        if flame is not None:
            raise FaceDiffError(f"{path}: holds no FLAME parameters; leave --flame away, or give .hdf5 or .npy")
        raise FaceDiffError(f"{path}: not a form of motion that is known; expected {kinds}")
    if flame is None:
        raise FaceDiffError(f"{path}: holds FLAME parameters; add --flame MODEL, your own FLAME model file")
    return _read_flame(path, flame, n_vertices, scratch)


def open_array(path: Path) -> npt.NDArray[np.floating]:
    """A .npy file of numbers, memory-mapped.

    Raises:
        FaceDiffError: if it is missing, damaged, empty, or holds anything but floating-point numbers.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError) as error:
        raise FaceDiffError(f"{path}: not a readable NumPy array ({error}); expected .npy with numbers") from error
    if not isinstance(array, np.ndarray) or not np.issubdtype(array.dtype, np.floating) or not array.size:
        kind = f"{array.dtype} {array.shape}" if isinstance(array, np.ndarray) else "an archive"
        raise FaceDiffError(f"{path}: holds {kind}; expected floating-point numbers")
    return array


def _as_vertices(array: npt.NDArray[np.floating], n_vertices: int) -> npt.NDArray[np.floating] | None:
    if array.ndim == 3 and array.shape[1:] == (n_vertices, 3):
        return array
    if array.ndim == 2 and array.shape[1] == 3 * n_vertices:
        return array.reshape(len(array), n_vertices, 3)
    return None


def _read_flame(path: Path, model: Path, n_vertices: int, scratch: Path) -> Motion:
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
    return Motion(frames, faces, np.asarray(template, np.float64), has_head_motion=False)
