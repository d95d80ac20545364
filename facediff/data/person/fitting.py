"""Fitting a speaker into a corpus: reading the motion, head motion, neutral face, and the way into its coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import LIP_PAIRS, MOTION_FOLDERS, find_region, read_manifest, read_templates
from facediff.data.reconstructions import read_parameters
from facediff.data.track.face import pair_distances
from facediff.errors import FaceDiffError
from facediff.mesh import Similarity, face_size, median_face, remove_rigid_motion, robust_align
from facediff.mesh.alignment import chunks
from facediff.mesh.flame import Flame
from facediff.metrics import LipPairs
from facediff.speech.audio import SAMPLE_RATE
from facediff.utils.arrays import open_array, vertices_of
from facediff.utils.files import reserve_room
from facediff.utils.hdf5 import HDF5_SUFFIXES
from facediff.utils.numerics import Indices

Array = npt.NDArray[np.float64]
Speech = npt.NDArray[np.float32]

RESIDUAL_LIMIT = 0.15
"""Largest residual of a face laid onto the corpus's mean face, as a share of its size (root mean squares).

Faces of different speakers differ by some hundredths; vertices in another order by about 1.
"""
SAME_UNIT = 1.2  # a speaker's face and the corpus's mean face differ in size by less than this factor
MIN_STABLE = 10
STILL = 1e-6  # of the face's size: slower motion counts as none
SAME_SIZE = 1.1  # template and motion must agree in size to this factor
SMOOTHING = 0.2  # seconds over which loudness is averaged
NEUTRAL_SHARE = 0.05  # share of the frames that the neutral face is the median of
CLOSED = 0.012  # gap of closed lips as a share of the face's size, about 1 mm
CLOSED_SHARE = 1 / 3  # of the frames with closed lips
NEUTRAL_FRAMES = (5, 50)  # at least and at most so many
LISTED = 10  # frames that the report names
FLAME_FRAMES = 64  # frames that the FLAME layer works on at a time


# The corpus that the speaker is to join: its topology, coordinates and frame rate.


@dataclass(frozen=True)
class TargetCorpus:
    """The properties that a new speaker must match: mean (V, 3) of the templates, rate, unit."""

    root: Path
    mean: Array
    frame_rate: float
    unit: str | None
    lip_pairs: Indices | None  # (P, 2) upper and lower vertices of the inner lips


def read_target_corpus(root: Path, name: str) -> TargetCorpus:
    """Read the corpus that a speaker of a new name joins."""
    templates = read_templates(root / "templates.pkl")
    stems = {path.stem for folder in MOTION_FOLDERS for path in (root / folder).glob("*.npy")}
    subjects = {*templates, *(stem.rpartition("_")[0] for stem in stems)}
    if name.casefold() in {subject.casefold() for subject in subjects}:
        raise FaceDiffError(f"--name {name}: {root} has a speaker of that name already; choose another name")
    manifest = read_manifest(root)
    if not (rate := manifest.get("frame_rate")):
        raise FaceDiffError(
            f'{root / "manifest.json"}: has no frame rate; write the corpus\'s, such as {{"frame_rate": 25}}'
        )
    pairs = root / LIP_PAIRS
    return TargetCorpus(
        root,
        np.stack([template.numpy() for template in templates.values()]).astype(np.float64).mean(axis=0),
        float(rate),
        manifest.get("unit"),
        np.array(LipPairs.from_file(pairs).pairs) if pairs.is_file() else None,
    )


# The motion of a speaker: vertices, or FLAME parameters.


@dataclass(frozen=True)
class FaceSequence:
    """A sequence of faces as read."""

    frames: npt.NDArray[np.floating]  # (T, V, 3), usually memory-mapped
    template: Array | None = None  # (V, 3) neutral face, where the source has one

    @property
    def has_head_motion(self) -> bool:
        """Whether the head moves: FLAME parameters are read without their head pose."""
        return self.template is None


def read_motion(path: Path, n_vertices: int, scratch: Path, flame: Path | None) -> FaceSequence:
    """Read a .npy array of vertices, or FLAME parameters by the model file ``flame``, into a temporary file."""
    if flame is not None:
        parameters, layer = read_parameters(path), Flame.read(flame)
        template = np.asarray(layer.shaped(parameters.shape), np.float64)
        frames = scratch_array(scratch, (len(parameters.expression), *template.shape))
        for first in range(0, len(frames), FLAME_FRAMES):
            part = slice(first, first + FLAME_FRAMES)
            frames[part] = layer.vertices(parameters.shape, parameters.expression[part], parameters.jaw[part])
        if len(template) == n_vertices:
            return FaceSequence(frames, template)
    array = np.empty(0) if path.suffix.lower() in HDF5_SUFFIXES else open_array(path, kinds="f")
    if vertices_of(array.shape) != n_vertices:
        raise FaceDiffError(
            f"{path}: has shape {array.shape}; expected (frames, {n_vertices}, 3) or (frames, {3 * n_vertices}) like "
            f"the corpus, or FLAME parameters with --flame MODEL of as many vertices"
        )
    return FaceSequence(array.reshape(len(array), n_vertices, 3))


def scratch_array(path: Path, shape: tuple[int, ...]) -> npt.NDArray[np.float32]:
    """A new memory-mapped float32 array."""
    array: npt.NDArray[np.float32] = np.lib.format.open_memmap(path, mode="w+", dtype=np.float32, shape=shape)
    reserve_room(path)
    return array


# The way into the corpus's coordinates.


def lay_onto_corpus(path: Path, face: Array, target: TargetCorpus) -> tuple[Similarity, float]:
    """The similarity transform from a face to the corpus's mean face, and its residual as a share of the size."""
    map_ = robust_align(face, target.mean, scale=True)
    residual = relative_residual(map_.apply(face), target.mean)
    if not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{path}: its face does not lie on those of {target.root} (residual {residual:.2f} of its size, expected "
            f"less than {RESIDUAL_LIMIT}), so its topology or the order of its vertices differs, or it is mirrored"
        )
    return map_, residual


def relative_residual(face: Array, target: Array) -> float:
    """Root-mean-square distance of two faces (V, 3), as a share of the target's size."""
    return float(np.sqrt(np.square(face - target).sum(axis=-1).mean())) / face_size(target)


def into_coordinates(face: Array, best: Similarity) -> Similarity:
    """The similarity that takes a speaker into the corpus's coordinates.

    Its scale changes the unit and keeps the speaker's size: where the measured scale is near a power of ten
    (millimetres, centimetres, metres), it is that power; else, as with a corpus of normalised size, it is as measured.
    ``best`` lays the speaker's neutral face onto the corpus's mean face best, and is kept but for its scale, about the
    face's centre.
    """
    power = round(math.log10(best.scale))
    is_unit = abs(math.log10(best.scale) - power) < math.log10(SAME_UNIT)
    scale = 10.0**power if is_unit else best.scale
    centre = face.mean(axis=0)
    return Similarity(best.rotation, best.apply(centre) - scale * best.rotation @ centre, scale)


# Removing the head's motion from the frames, and measuring how much of it there was.


@dataclass(frozen=True)
class StabilisedMotion:
    """Frames without head motion; lengths are in the motion's unit."""

    frames: npt.NDArray[np.floating]  # (T, V, 3), in the pose of the face
    face: Array  # (V, 3), the frames' median
    stable: Indices  # the vertices from which the head's motion was measured
    turns: Array  # (T,) angle of the head from its mean pose, in radians
    shifts: Array  # (T,) distance of the head from its mean place
    jitter: float  # root-mean-square distance of the stable vertices from the face
    speed: Array  # (T,) mean step of the vertices from frame to frame


def read_stable(source: str, n_vertices: int) -> Indices:
    """Stable vertices from a text file of indices, or from ``FLAME_masks.pkl:scalp+forehead``."""
    file = Path(source.partition(".pkl:")[0] + ".pkl" if ".pkl:" in source else source)
    region = find_region(file.parent, [Path(source).name], "stable vertices", n_vertices)
    if region.count < MIN_STABLE:
        raise FaceDiffError(
            f"--stable {file}: names {region.count} vertices; expected at least {MIN_STABLE}, spread over the skull"
        )
    return np.array(region.indices, np.int64)


def stabilise(motion: FaceSequence, face: Array, stable: Indices, scratch: Path) -> StabilisedMotion:
    """Align every frame with the median face (V, 3); parameters without head motion stay as they are."""
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
        raise FaceDiffError("the motion is still: every frame is the same face; expected the frames of a video")
    return StabilisedMotion(frames, face, stable, turns, shifts, float(np.sqrt(np.square(residuals).mean())), speed)


def middle_face(motion: FaceSequence, stable: Indices) -> Array:
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
    centres = np.einsum("tji,tj->ti", rotations, centre - translations)
    return 2.0 * np.arcsin(np.clip(chord / np.sqrt(8.0), 0.0, 1.0)), np.linalg.norm(centres - centres.mean(0), axis=1)


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


# The neutral face: given, known from the model, or found where the speaker is silent and still.


@dataclass(frozen=True)
class NeutralFace:
    """A neutral face (V, 3)."""

    face: Array
    placing: Similarity  # from the stabilised frames' coordinates to those of the face; a rigid motion
    source: str  # how the face was obtained, in words
    frames: list[int] = field(default_factory=list)  # those it is the median of, counted from 0, if it was found there


def choose_neutral(
    motion: FaceSequence,
    stabilised: StabilisedMotion,
    template: Path | None,
    speech: Speech,
    frame_rate: float,
    lip_pairs: Indices | None = None,
) -> NeutralFace:
    """The neutral face that was given, else the source's own, else one found in the frames without head motion."""
    if template is not None:
        return _given(stabilised, template)
    unmoved = Similarity(np.eye(3), np.zeros(3))
    if motion.template is not None:
        return NeutralFace(motion.template, unmoved, "the model's shape without expression")
    covered = max(1, min(len(stabilised.frames), round(len(speech) / SAMPLE_RATE * frame_rate)))
    gaps = None if lip_pairs is None else pair_distances(stabilised.frames[:covered], lip_pairs)
    closed = CLOSED * face_size(stabilised.face)
    frames = neutral_frames(loudness(speech, covered, frame_rate), stabilised.speed[:covered], gaps, closed).tolist()
    face = np.median(stabilised.frames[frames], axis=0).astype(np.float64)
    mouth = "" if gaps is None else ", with the mouth closed,"
    listed = ", ".join([*map(str, frames[:LISTED]), *(["…"] if len(frames) > LISTED else [])])
    source = f"median of {len(frames)} silent and still frames{mouth} (counted from 0): {listed}"
    return NeutralFace(face, unmoved, source, frames)


def _given(stabilised: StabilisedMotion, path: Path) -> NeutralFace:
    """A neutral face from .npy, and the rigid motion from the stabilised frames to it, by the stable vertices."""
    template = np.array(open_array(path, kinds="f"), np.float64).reshape(-1, 3)
    ratio = residual = math.nan
    if template.shape == stabilised.face.shape and np.isfinite(template).all():
        face, target = stabilised.face[stabilised.stable], template[stabilised.stable]
        ratio = robust_align(face, target, scale=True).scale
        rigid = robust_align(face, target)
        residual = relative_residual(rigid.apply(stabilised.face), template)
    if not abs(math.log(max(ratio, 1e-9))) < math.log(SAME_SIZE) or not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{path}: has {len(template)} vertices, is {ratio:.4g} times as large as the faces of the motion, and does "
            f"not lie on them (residual {residual:.2f} of its size, expected less than {RESIDUAL_LIMIT}); expected the "
            f"speaker's neutral face in the motion's own unit and vertex order"
        )
    return NeutralFace(template, rigid, str(path))


def loudness(speech: Speech, frames: int, frame_rate: float, smoothing: float = SMOOTHING) -> Array:
    """Root-mean-square loudness around every frame (T,), averaged over 0.2 s or other seconds."""
    energy = np.concatenate([[0.0], np.cumsum(np.square(speech, dtype=np.float64))])
    middle = (np.arange(frames) + 0.5) / frame_rate
    low, high = (
        np.clip(((middle + side * smoothing / 2) * SAMPLE_RATE).round().astype(int), 0, len(speech)) for side in (-1, 1)
    )
    return np.sqrt((energy[high] - energy[low]) / np.maximum(high - low, 1))


def neutral_frames(loud: Array, speed: Array, gaps: Array | None = None, closed: float = 0.0) -> Indices:
    """Frames in which speech is quiet and the face is still, both; sorted indices.

    Frames are ranked by loudness and by speed; those with the lowest maximum of both ranks are chosen: a twentieth of
    all or, where the gap between the lips is known, a third of those in which it is smallest. People breathe through an
    open mouth in pauses, so that quiet frames alone would give an open mouth.

    Args:
        loud: loudness of the speech (T,).
        speed: of the face (T,).
        gaps: between the inner lips (T,).
        closed: gap of closed lips; frames with a larger one count only among the smallest tenth.
    """
    frames = np.arange(len(loud)) if gaps is None else np.flatnonzero(gaps <= max(closed, np.quantile(gaps, 0.1)))
    ranks = np.maximum(*(np.searchsorted(np.sort(values), values) for values in (loud[frames], speed[frames])))
    share = NEUTRAL_SHARE if gaps is None else CLOSED_SHARE
    count = min(len(frames), int(np.clip(round(share * len(frames)), *NEUTRAL_FRAMES)))
    return np.sort(frames[np.argsort(ranks, kind="stable")[:count]])
