"""Motion in any of the forms that reconstruction tools write."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.audio import SAMPLE_RATE
from facediff.data.corpus import find_region
from facediff.data.person.frames import (
    MESHES,
    RESIDUAL_LIMIT,
    Auxiliary,
    Faces,
    check_faces,
    read_frames,
    relative_residual,
    scratch_array,
    spans,
)
from facediff.data.prepare.motion import read_parameters
from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, face_size, median_face, read_mesh, remove_rigid_motion, robust_align
from facediff.mesh.alignment import Indices, chunks
from facediff.mesh.flame import Flame
from facediff.utils.arrays import open_array

# What is done by the loudness of speech: finding frames of a neutral face, and cutting into clips.

Array = npt.NDArray[np.float64]
Speech = npt.NDArray[np.float32]

SMOOTHING = 0.2
"""Seconds over which loudness is averaged."""
NEUTRAL_SHARE = 0.05
"""Share of the frames that the neutral face is the median of."""
NEUTRAL_FRAMES = (5, 50)
"""At least and at most so many."""
SLACK = 0.25
"""How far a cut may lie from an equal division, as a share of a clip."""


def loudness(speech: Speech, frames: int, frame_rate: float) -> Array:
    """Root-mean-square loudness around every frame (T,), averaged over 0.2 s."""
    energy = np.concatenate([[0.0], np.cumsum(np.square(speech, dtype=np.float64))])
    middle = (np.arange(frames) + 0.5) / frame_rate
    low, high = (
        np.clip(((middle + side * SMOOTHING / 2) * SAMPLE_RATE).round().astype(int), 0, len(speech)) for side in (-1, 1)
    )
    return np.sqrt((energy[high] - energy[low]) / np.maximum(high - low, 1))


def neutral_frames(loud: Array, speed: Array) -> npt.NDArray[np.int64]:
    """The twentieth of the frames in which speech is quiet and the face is still, both; sorted indices.

    Frames are ranked by loudness and by speed; those whose worse rank is best are taken.
    """
    worse = np.maximum(*(np.searchsorted(np.sort(values), values) for values in (loud, speed)))
    least, most = NEUTRAL_FRAMES
    count = min(len(loud), max(least, min(most, round(NEUTRAL_SHARE * len(loud)))))
    return np.sort(np.argsort(worse, kind="stable")[:count])


def cut_points(loud: Array, clip_frames: float) -> list[tuple[int, int]]:
    """Divide frames into clips of about equal length, each cut at the quietest frame near its place.

    Args:
        loud: (T,) loudness.
        clip_frames: wanted length of a clip, in frames.

    Returns:
        first frame and frame after the last of every clip; together they are all frames.
    """
    clips = max(1, round(len(loud) / clip_frames))
    length = len(loud) / clips
    cuts = [0]
    for i in range(1, clips):
        first = max(cuts[-1] + 1, round((i - SLACK) * length))
        window = loud[first : max(first + 1, round((i + SLACK) * length))]
        quiet = np.flatnonzero(window == window.min())
        cuts.append(first + int(quiet[len(quiet) // 2]))  # the middle of a pause, where it is wholly silent
    return list(zip(cuts, [*cuts[1:], len(loud)], strict=True))


def splits(clips: int) -> list[str]:
    """Split of every clip: the last 15 % ``test``, the 10 % before them ``val``, the rest ``train``.

    With four clips or more there is at least one of each; fewer are all ``train``.
    """
    if clips < 4:
        return ["train"] * clips
    test, val = max(1, round(0.15 * clips)), max(1, round(0.10 * clips))
    return ["train"] * (clips - val - test) + ["val"] * val + ["test"] * test


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
        array = open_array(path, kinds="f")
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


# Taking the head's motion out of a person's frames, and saying how much of it there was.

MIN_STABLE = 10
STILL = 1e-6
"""Motion whose fastest frame moves by less than this share of the face's size is none."""


@dataclass(frozen=True)
class Stabilised:
    """Frames without head motion.

    Attributes:
        frames: (T, V, 3), in the pose of ``face``.
        face: (V, 3) their median.
        stable: the vertices that told the head's motion.
        turns: (T,) angle of the head from its mean pose, in radians.
        shifts: (T,) distance of the head from its mean place, in the motion's unit.
        jitter: root-mean-square distance of the stable vertices from ``face``, in the motion's unit.
        speed: (T,) mean step of the vertices from frame to frame, in the motion's unit.
    """

    frames: npt.NDArray[np.floating]
    face: Array
    stable: Indices
    turns: Array
    shifts: Array
    jitter: float
    speed: Array


def read_stable(source: str, n_vertices: int) -> Indices:
    """Stable vertices from a region file.

    Args:
        source: a text file of indices, or ``FLAME_masks.pkl:scalp+forehead``.
        n_vertices: vertices of the topology.

    Raises:
        FaceDiffError: if the file is missing or unfit.
    """
    file = Path(source.partition(".pkl:")[0] + ".pkl" if ".pkl:" in source else source)
    if not file.is_file():
        raise FaceDiffError(f"--stable {file}: no such file; expected vertex indices separated by commas")
    region = find_region(file.parent, [Path(source).name], "stable vertices", n_vertices)
    if region.count < MIN_STABLE:
        raise FaceDiffError(
            f"--stable {file}: names {region.count} vertices; expected at least {MIN_STABLE}, spread over the skull"
        )
    return np.array(region.indices, np.int64)


def stabilise(motion: Motion, face: Array, stable: Indices, scratch: Path) -> Stabilised:
    """Lay every frame onto the median face; parameters without head motion stay as they are.

    Args:
        motion: the frames.
        face: (V, 3) their median, see :func:`facediff.mesh.median_face`.
        stable: the vertices that tell the head's motion.
        scratch: a file to make for the frames.

    Raises:
        FaceDiffError: if a frame holds NaN, or if nothing moves.
    """
    count = len(motion.frames)
    if motion.has_head_motion:
        frames = scratch_array(scratch, motion.frames.shape)
        laid = remove_rigid_motion(motion.frames, face, stable, out=frames)
        turns, shifts = _head_motion(laid.rotations, laid.translations, face[stable].mean(axis=0))
        residuals = laid.residuals
    else:
        frames, turns, shifts = motion.frames, np.zeros(count), np.zeros(count)
        residuals = np.array([np.sqrt(np.square(frame[stable] - face[stable]).sum(axis=-1).mean()) for frame in frames])
    speed = _speed(frames)
    if speed.max() < STILL * face_size(face):
        raise FaceDiffError("the motion holds none: every frame is the same face; expected the frames of a video")
    return Stabilised(frames, face, stable, turns, shifts, float(np.sqrt(np.square(residuals).mean())), speed)


def middle_face(motion: Motion, stable: Indices) -> Array:
    """The median face of a motion; of parameters without head motion, in the coordinates that they have."""
    if motion.has_head_motion:
        return median_face(motion.frames, stable)
    return np.median(motion.frames[:: max(1, len(motion.frames) // 64)], axis=0).astype(np.float64)


def _head_motion(rotations: Array, translations: Array, centre: Array) -> tuple[Array, Array]:
    """Angles from the mean pose, and distances from the mean place, of the head.

    The mean pose is the rotation nearest to the mean of the matrices (the chordal mean).
    """
    u, _, vt = np.linalg.svd(rotations.mean(axis=0))
    mean = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
    # |R - M|² = 8 sin²(angle / 2): exact for small angles too, where the arc cosine of the trace is not.
    chord = np.sqrt(np.square(rotations - mean).sum(axis=(1, 2)))
    places = np.einsum("tji,tj->ti", rotations, centre - translations)
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0)), np.linalg.norm(places - places.mean(0), axis=1)


def _speed(frames: npt.NDArray[np.floating]) -> Array:
    """Mean of the steps to the frame before and after, (T,).

    The mean length over vertices: a few that jitter count for less than in a root mean square.
    """
    steps = np.zeros(len(frames) + 1)
    last: Array | None = None
    for part, chunk in chunks(frames):
        joined = chunk if last is None else np.concatenate([last[None], chunk])
        moved = np.sqrt(np.square(np.diff(joined, axis=0)).sum(axis=-1)).mean(axis=-1)
        steps[part.stop - len(moved) : part.stop] = moved
        last = chunk[-1]
    if len(frames) > 1:
        steps[0], steps[-1] = steps[1], steps[-2]
    return (steps[:-1] + steps[1:]) / 2


# A person's neutral face: given, known from the model, or found where the person is silent and still.

SAME_SIZE = 1.1
"""Template and motion must agree in size to this factor."""


@dataclass(frozen=True)
class Template:
    """A neutral face that was given.

    Attributes:
        path: its file.
        vertices: (V, 3).
    """

    path: Path
    vertices: Array


@dataclass(frozen=True)
class Neutral:
    """A neutral face.

    Attributes:
        face: (V, 3).
        placing: from the stabilised frames' coordinates to those of ``face``; a rigid motion.
        source: where the face is from, in words.
        frames: the frames it is the median of, counted from 0; empty if it was not found in the motion.
    """

    face: Array
    placing: Similarity
    source: str
    frames: list[int] = field(default_factory=list)


def choose_neutral(
    motion: Motion, made: Stabilised, given: Template | None, speech: npt.NDArray[np.float32], frame_rate: float
) -> Neutral:
    """The neutral face that was given, else the source's own, else one found in the frames.

    Args:
        motion: the frames as read.
        made: the same without head motion.
        given: a template, or None.
        speech: (S,) at 16 kHz.
        frame_rate: frames a second.

    Raises:
        FaceDiffError: if the template that was given does not fit the frames.
    """
    if given is not None:
        return Neutral(given.vertices, _onto_template(made, given), str(given.path))
    unmoved = Similarity(np.eye(3), np.zeros(3))
    if motion.template is not None:
        return Neutral(motion.template, unmoved, "the model's shape without expression")
    covered = max(1, min(len(made.frames), round(len(speech) / SAMPLE_RATE * frame_rate)))
    chosen = neutral_frames(loudness(speech, covered, frame_rate), made.speed[:covered]).tolist()
    face = np.median(made.frames[chosen], axis=0).astype(np.float64)
    source = f"median of {len(chosen)} silent and still frames (counted from 0): {spans(chosen)}"
    return Neutral(face, unmoved, source, chosen)


def _onto_template(made: Stabilised, given: Template) -> Similarity:
    """The rigid motion from the stabilised frames to a template, by the stable vertices."""
    face, template = made.face[made.stable], given.vertices[made.stable]
    ratio = robust_align(face, template, scale=True).scale
    rigid = robust_align(face, template)
    residual = relative_residual(rigid.apply(made.face), given.vertices)
    if not abs(math.log(max(ratio, 1e-9))) < math.log(SAME_SIZE):
        raise FaceDiffError(
            f"{given.path}: is {ratio:.4g} times as large as the faces of the motion; expected the person's neutral "
            f"face in the motion's own unit and vertex order"
        )
    if not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{given.path}: does not lie on the faces of the motion (residual {residual:.2f} of its size, expected "
            f"less than {RESIDUAL_LIMIT}); expected the person's neutral face in the motion's own vertex order"
        )
    return rigid


def read_template(path: Path, corpus: Auxiliary) -> Template:
    """A neutral face from .obj, .ply or .npy.

    Raises:
        FaceDiffError: if it is none of these, damaged, of another topology than the corpus, or holds NaN.
    """
    suffix, faces, count = path.suffix.lower(), None, corpus.n_vertices
    vertices: Array
    if suffix == ".npy":
        array = open_array(path, kinds="f")
        if array.size != 3 * count:
            raise FaceDiffError(f"{path}: has shape {array.shape}; expected ({count}, 3) like the corpus")
        vertices = np.array(array, np.float64).reshape(count, 3)
    elif suffix in MESHES:
        mesh = read_mesh(path, points_allowed=True)
        vertices, faces = mesh.vertices, mesh.faces if len(mesh.faces) else None
        if len(vertices) != count:
            raise FaceDiffError(
                f"{path}: has {len(vertices)} vertices, but the corpus has {count}; its topology is another"
            )
    else:
        raise FaceDiffError(f"{path}: not a template that is known; expected .obj, .ply or .npy")
    if not np.isfinite(vertices).all():
        raise FaceDiffError(f"{path}: holds NaN or infinity; expected a neutral face")
    check_faces(path, faces, corpus)
    return Template(path, vertices)
