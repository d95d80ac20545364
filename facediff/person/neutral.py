"""A person's neutral face: given, known from the model, or found where the person is silent and still."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.data.audio import SAMPLE_RATE
from facediff.errors import FaceDiffError
from facediff.person.auxiliary import RESIDUAL_LIMIT, Auxiliary, check_faces, relative_residual
from facediff.person.frames import spans
from facediff.person.meshes import MESHES, read_frame_mesh
from facediff.person.motion import Motion, open_array
from facediff.person.speech import loudness, neutral_frames
from facediff.person.stabilise import Stabilised
from facediff.topology import Similarity, robust_align

Array = npt.NDArray[np.float64]

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
        array = open_array(path)
        if array.size != 3 * count:
            raise FaceDiffError(f"{path}: has shape {array.shape}; expected ({count}, 3) like the corpus")
        vertices = np.array(array, np.float64).reshape(count, 3)
    elif suffix in MESHES:
        mesh = read_frame_mesh(path)
        vertices, faces = mesh.vertices, mesh.faces
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
