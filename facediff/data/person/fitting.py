"""Fitting a speaker into a corpus: head motion, neutral face, and the way into the corpus's coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.corpus import LIP_PAIRS, MOTION_FOLDERS, find_region, read_manifest, read_templates
from facediff.data.person.face_sequences import (
    MESHES,
    Array,
    Faces,
    FaceSequence,
    differing_faces,
    scratch_array,
    spans,
)
from facediff.data.track.face import pair_distances
from facediff.errors import FaceDiffError, OptionError
from facediff.mesh import Similarity, face_size, median_face, read_mesh, remove_rigid_motion, robust_align
from facediff.mesh.alignment import chunks
from facediff.metrics import LipPairs
from facediff.speech.audio import SAMPLE_RATE
from facediff.utils.arrays import open_array
from facediff.utils.numerics import Indices

Speech = npt.NDArray[np.float32]

RESIDUAL_LIMIT = 0.15
"""Largest residual of a face laid onto the corpus's mean face, as a share of its size (root mean squares).

Faces of different speakers differ by some hundredths; vertices in another order by about 1.
"""
SAME_UNIT = 1.2  # a speaker's face and the corpus's mean face differ in size by less than this factor
MOST_SCALED = 3.0  # a scale that is given makes a face at most so many times larger or smaller than the corpus's
MIN_STABLE = 10
STILL = 1e-6  # of the face's size: slower motion counts as none
SAME_SIZE = 1.1  # template and motion must agree in size to this factor
SMOOTHING = 0.2  # seconds over which loudness is averaged
NEUTRAL_SHARE = 0.05  # share of the frames that the neutral face is the median of
CLOSED = 0.012  # gap of closed lips as a share of the face's size, about 1 mm
CLOSED_SHARE = 1 / 3  # of the frames with closed lips
NEUTRAL_FRAMES = (5, 50)  # at least and at most so many


# The corpus that the speaker is to join: its topology, coordinates and frame rate.


@dataclass(frozen=True)
class TargetCorpus:
    """The properties that a new speaker must match: mean (V, 3) of the templates, triangles (F, 3), rate, unit."""

    root: Path
    mean: Array
    faces: Faces | None
    frame_rate: float
    unit: str | None
    lip_pairs: Indices | None = None  # (P, 2) upper and lower vertices of the inner lips

    @property
    def n_vertices(self) -> int:
        """Vertices of its topology."""
        return len(self.mean)


def read_target_corpus(root: Path, *, name: str, frame_rate: float | None) -> TargetCorpus:
    """Read the corpus that a speaker joins; ``frame_rate`` is needed where ``manifest.json`` does not record it."""
    templates = read_templates(root / "templates.pkl")
    stems = {path.stem for folder in MOTION_FOLDERS for path in (root / folder).glob("*.npy")}
    subjects = {*templates, *(stem.rpartition("_")[0] for stem in stems)}
    if name.casefold() in {subject.casefold() for subject in subjects}:
        raise FaceDiffError(f"--name {name}: {root} has a speaker of that name already; choose another name")
    manifest = read_manifest(root)
    unit = manifest.get("unit")
    mean: Array = np.stack([template.numpy() for template in templates.values()]).astype(np.float64).mean(axis=0)
    return TargetCorpus(
        root,
        mean,
        _corpus_faces(root, len(mean)),
        _frame_rate(root, manifest.get("frame_rate"), frame_rate),
        unit if isinstance(unit, str) else None,
        np.array(LipPairs.from_file(root / LIP_PAIRS).pairs) if (root / LIP_PAIRS).is_file() else None,
    )


def _frame_rate(root: Path, recorded: float | None, option: float | None) -> float:
    if (rate := recorded or option) is None or abs(rate - (option or rate)) > 1e-6:
        raise FaceDiffError(
            f"--corpus-frame-rate {option or 'is missing'}: {root / 'manifest.json'} has {recorded or 'none'}; "
            f"expected the frame rate of the corpus in one of them"
        )
    return float(rate)


def _corpus_faces(root: Path, n_vertices: int) -> Faces | None:
    """Faces of the first mesh in the folder or in ``templates/`` that has the right vertex count."""
    for folder in (root, root / "templates"):
        for path in sorted(folder.glob("*")):
            if path.suffix.lower() in MESHES and path.is_file():
                mesh = read_mesh(path, points_allowed=True)
                if len(mesh.vertices) == n_vertices and len(mesh.faces):
                    return mesh.faces
    return None


def check_faces(path: Path, faces: Faces | None, target: TargetCorpus) -> bool:
    """Whether faces could be compared with the corpus's; an error if they differ."""
    if faces is None or target.faces is None:
        return False
    if differing := differing_faces(faces, target.faces):
        raise FaceDiffError(
            f"{path}: {differing} triangles are not those of the mesh in {target.root}, so the topology differs; if "
            f"only polygons were triangulated differently, give the motion as a .npy array, which has no faces"
        )
    return True


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


def into_coordinates(face: Array, best: Similarity, fixed_scale: float | None) -> Similarity:
    """The similarity that takes a speaker into the corpus's coordinates.

    Its scale changes the unit and keeps the speaker's size: where the measured scale is near a power of ten
    (millimetres, centimetres, metres), it is that power; else, as with a corpus of normalised size, it is as measured.
    ``best`` lays the speaker's neutral face onto the corpus's mean face best, and is kept but for its scale, about the
    face's centre; a scale that is given is used instead.
    """
    if fixed_scale is not None and not abs(math.log(fixed_scale / best.scale)) < math.log(MOST_SCALED):
        raise OptionError(
            "scale",
            f"makes a face {fixed_scale / best.scale:.3g} times as large as the corpus's; expected corpus units to a "
            f"unit of the motion, about {best.scale:.3g} by the size of the face",
            f"{fixed_scale:g}",
        )
    power = round(math.log10(best.scale))
    is_unit = abs(math.log10(best.scale) - power) < math.log10(SAME_UNIT)
    scale = fixed_scale if fixed_scale is not None else 10.0**power if is_unit else best.scale
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
class TemplateFile:
    """A neutral face (V, 3) that was given, and its file."""

    path: Path
    vertices: Array


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
    template: TemplateFile | None,
    speech: npt.NDArray[np.float32],
    frame_rate: float,
    lip_pairs: Indices | None = None,
) -> NeutralFace:
    """The neutral face that was given, else the source's own, else one found in the frames without head motion."""
    if template is not None:
        return NeutralFace(template.vertices, _onto_template(stabilised, template), str(template.path))
    unmoved = Similarity(np.eye(3), np.zeros(3))
    if motion.template is not None:
        return NeutralFace(motion.template, unmoved, "the model's shape without expression")
    covered = max(1, min(len(stabilised.frames), round(len(speech) / SAMPLE_RATE * frame_rate)))
    gaps = None if lip_pairs is None else pair_distances(stabilised.frames[:covered], lip_pairs)
    closed = CLOSED * face_size(stabilised.face)
    frames = neutral_frames(loudness(speech, covered, frame_rate), stabilised.speed[:covered], gaps, closed).tolist()
    face = np.median(stabilised.frames[frames], axis=0).astype(np.float64)
    mouth = "" if gaps is None else ", with the mouth closed,"
    source = f"median of {len(frames)} silent and still frames{mouth} (counted from 0): {spans(frames)}"
    return NeutralFace(face, unmoved, source, frames)


def _onto_template(stabilised: StabilisedMotion, template: TemplateFile) -> Similarity:
    """The rigid motion from the stabilised frames to a template, by the stable vertices."""
    face, target = stabilised.face[stabilised.stable], template.vertices[stabilised.stable]
    ratio = robust_align(face, target, scale=True).scale
    rigid = robust_align(face, target)
    residual = relative_residual(rigid.apply(stabilised.face), template.vertices)
    if not abs(math.log(max(ratio, 1e-9))) < math.log(SAME_SIZE) or not residual < RESIDUAL_LIMIT:
        raise FaceDiffError(
            f"{template.path}: is {ratio:.4g} times as large as the faces of the motion, and does not lie on them "
            f"(residual {residual:.2f} of its size, expected less than {RESIDUAL_LIMIT}); expected the speaker's "
            f"neutral face in the motion's own unit and vertex order"
        )
    return rigid


def read_template(path: Path, target: TargetCorpus) -> TemplateFile:
    """A neutral face from .obj, .ply or .npy."""
    faces: Faces | None = None
    if path.suffix.lower() in MESHES:
        mesh = read_mesh(path, points_allowed=True)
        vertices, faces = mesh.vertices, mesh.faces if len(mesh.faces) else None
    else:
        vertices = np.array(open_array(path, kinds="f"), np.float64).reshape(-1, 3)
    if len(vertices) != target.n_vertices or not np.isfinite(vertices).all():
        raise FaceDiffError(
            f"{path}: has {len(vertices)} vertices, or NaN among them; expected {target.n_vertices} finite ones like "
            f"the corpus, from .obj, .ply or .npy"
        )
    check_faces(path, faces, target)
    return TemplateFile(path, vertices)


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
