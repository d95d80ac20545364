"""Eyelids and eyeballs of a face, and how the lids shut: known for the built-in puppet, else from the user's file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import OptionError, damaged
from facediff.utils.arrays import open_array
from facediff.utils.numerics import Array, Floats, Indices, Integers, smooth_step
from facediff.utils.plain_files import load_json
from facediff.utils.records import read_record

GIVE = (
    "give {eyes}: a file that says where lids and eyeballs are (docs/animation_controls.md shows one for FLAME and for "
    "any mesh)"
)
STILL = 0.01  # Floats that a blink moves by less than this share of its largest way are left alone
MEET = 0.12  # Where the lids meet, from the lower (0) to the upper edge (1): the lower lid hardly rises in a blink
AHEAD = 0.025
"""The shut upper lid lies further out by this share of the eye's width: its way is straight, the eyeball is round."""
REACH = 0.4  # How far from the edges the skin follows, as a share of the eye's width
PLAUSIBLE = (0.002, 0.2)  # The largest way of a lid, as a share of the face's size (the diagonal of its box)
SAME_FACE = 1e-3  # Metres that a face may differ from a puppet's to count as that puppet's


@dataclass(frozen=True, eq=False)
class Eyes:
    """The eyes of a face."""

    # (V, 3) displacements from open to shut lids, in the face's unit; None if they are not known
    closing: npt.NDArray[np.float32] | None
    eyeballs: tuple[Indices, ...]  # vertices of each eyeball
    source: str  # for messages
    brows: Indices | None = None  # vertices of both brows; None if they are not known

    def lids(self) -> tuple[Indices, npt.NDArray[np.float32]]:
        """The vertices (L,) that a blink moves, and their ways (L, 3); refused if the way is not known."""
        if self.closing is None:
            raise OptionError.naming(f"{self.source}: does not say how the lids shut; {GIVE}")
        lengths = np.linalg.norm(self.closing, axis=-1)
        vertices = np.flatnonzero(lengths > STILL * lengths.max())
        return vertices, self.closing[vertices]


def eyes_for(template: Floats, faces: Integers | None, file: Path | None) -> Eyes | None:
    """The eyes of a face (V, 3): from the file if there is one, else the puppet's if it is a puppet, else None."""
    return read_eyes(file, template) if file is not None else puppet_eyes(template, faces)


def puppet_eyes(template: Floats, faces: Integers | None) -> Eyes | None:
    """The eyes of a face (V, 3) of the built-in corpus, by the rig of its blinks; None for other faces."""
    from facediff.synthetic.known_faces import known_face

    face = known_face(template, faces)
    if face is None:
        return None
    if face.distance <= SAME_FACE:
        closing = face.closing.astype(np.float32)
    else:  # another speaker's face on the puppet's mesh has no rig: the edges of its own lids say how they shut
        closing = closing_of_lids(template, face.lids, np.concatenate(face.eyeballs))
    return Eyes(closing, face.eyeballs, "the built-in puppet")


def read_eyes(path: Path, template: Floats) -> Eyes:
    """The eyes of a face (V, 3) from a file.

    It names shapes of shut eyes or lists the lids' edges, and lists the eyeballs::

        {"neutral": "neutral.obj", "blinks": ["eyeBlinkLeft.obj", "eyeBlinkRight.obj"],
         "eyeballs": ["FLAME_masks.pkl:left_eyeball", "FLAME_masks.pkl:right_eyeball"],
         "brows": ["brows.txt"]}
    """
    record, count = read_record(_EyesFile, load_json(path, name=f"eyes {path}"), f"eyes {path}"), len(template)
    balls = tuple(_indices(path, entry, count, 4) for entry in record.eyeballs)
    brows = None
    if record.brows:
        entries = record.brows if any(isinstance(entry, str | list) for entry in record.brows) else [list(record.brows)]
        brows = np.unique(np.concatenate([_indices(path, entry, count) for entry in entries]))
    size = float(np.linalg.norm(np.ptp(template, axis=0)))
    closing: Floats = np.zeros((1, 3))
    if record.blinks:
        neutral = _read_shape(path, record.neutral) if record.neutral else None
        with damaged(f"eyes {path}", 'give shapes of this face, and the open face of the same mesh as "neutral"'):
            for name in record.blinks:
                shape = _read_shape(path, name)
                closing = closing + (shape if Path(name).suffix.lower() == ".npy" else np.subtract(shape, neutral))  # type: ignore[arg-type]
        if neutral is not None:
            closing *= size / max(float(np.linalg.norm(np.ptp(neutral, axis=0))), 1e-12)
    elif record.lids:
        edges = [(_indices(path, lid.upper, count, 2), _indices(path, lid.lower, count, 2)) for lid in record.lids]
        closing = closing_of_lids(template, edges, np.concatenate(balls) if balls else None)
    else:
        return Eyes(None, balls, f"eyes {path}", brows)
    longest = float(np.linalg.norm(closing, axis=-1).max())
    if closing.shape != template.shape or not PLAUSIBLE[0] * size < longest < PLAUSIBLE[1] * size:
        raise OptionError.naming(
            f"{{eyes}} {path}: its blink has shape {closing.shape} and moves a lid by {longest:.3g}, on a face of "
            f'shape {template.shape} and size {size:.3g}; give the shape of shut eyes, and as "neutral" the open face '
            f"in the same unit"
        )
    return Eyes(np.asarray(closing, np.float32), balls, f"eyes {path}", brows)


@dataclass(frozen=True)
class _LidEdges:
    upper: Any
    lower: Any


@dataclass(frozen=True)
class _EyesFile:
    """The content of a .json file of eyes."""

    neutral: str | None = None
    blinks: tuple[str, ...] = ()
    lids: tuple[_LidEdges, ...] = ()
    eyeballs: tuple[Any, ...] = ()
    brows: tuple[Any, ...] = ()


def _read_shape(path: Path, name: str) -> Floats:
    """Floats of a mesh, or displacements (V, 3) of a .npy file, that the eyes' file names."""
    from facediff.mesh import read_mesh

    file = path.parent / name
    if file.suffix.lower() != ".npy":
        return read_mesh(file).vertices
    array = open_array(file, kinds="f", name=f"eyes {path}: {file}")
    return np.asarray(array.reshape(-1, 3), np.float64)


def _indices(path: Path, entry: object, n_vertices: int, least: int = 1) -> Indices:
    """Indices in their order: a list of them, a text file, or a mask of a pickle (``FLAME_masks.pkl:left_eyeball``)."""
    from facediff.mesh.flame import read_masks
    from facediff.metrics.regions import read_indices

    with damaged(f"eyes {path}", "expected lists of vertex indices"):
        if isinstance(entry, str):
            file, _, mask = entry.partition(":") if ".pkl:" in entry else (entry, "", "")
            entry = read_masks(path.parent / file, mask) if file.endswith(".pkl") else read_indices(path.parent / file)
        indices = np.asarray(entry)
    is_list = indices.ndim == 1 and len(indices) >= least and np.issubdtype(indices.dtype, np.integer)
    if not is_list or not 0 <= indices.min() <= indices.max() < n_vertices:
        raise OptionError.naming(
            f"{{eyes}} {path}: expected lists of vertex indices from 0 to {n_vertices - 1}: at least 4 of an eyeball, "
            f"2 of a lid's edge"
        )
    return indices.astype(np.int64)


def closing_of_lids(
    template: Floats, lids: list[tuple[Indices, Indices]], rigid: Indices | None = None
) -> npt.NDArray[np.float32]:
    """How the lids of a face (V, 3), y up and z to the viewer, shut: ways (V, 3) from the vertices of their edges.

    For each eye, the upper and the lower edge run from one corner to the other. Each edge vertex goes to the line
    between them at its own share of the way along; the skin around follows its nearest edge vertices, less and less up
    to 0.4 of the eye's width away. ``rigid`` vertices (eyeballs) do not follow.
    """
    points = np.asarray(template, np.float64)
    closing = np.zeros_like(points)
    for upper, lower in lids:
        top, bottom = points[upper], points[lower]
        # Edges may be listed from either corner of the eye: the lower one is made to begin where the upper one does.
        if np.linalg.norm(top[0] - bottom[0]) > np.linalg.norm(top[0] - bottom[-1]):
            lower, bottom = lower[::-1], bottom[::-1]
        width = max(float(np.linalg.norm(np.ptp(edge, axis=0))) for edge in (top, bottom))
        edge = np.concatenate([upper, lower])
        way = np.concatenate([(1.0 - MEET) * _ways(top, bottom), MEET * _ways(bottom, top)])
        # The straight way between the edges would lead through the eyeball, which bulges most in the middle.
        way[:, 2] += AHEAD * width * np.concatenate([_arch(top), 0.5 * _arch(bottom)])
        distance = np.linalg.norm(points[:, None] - points[edge], axis=-1)
        near = np.flatnonzero(distance.min(axis=1) < REACH * width)
        share = 1.0 - smooth_step(distance[near].min(axis=1) / (REACH * width))
        # Inverse distances to the fourth power: at an edge vertex its own way alone, in between a blend.
        pull = 1.0 / np.maximum(distance[near], 1e-6 * width) ** 4
        blended = share[:, None] * (pull @ way) / pull.sum(axis=1, keepdims=True)
        # Where the reach of both eyes overlaps, at the bridge of the nose, the nearer eye decides.
        larger = np.linalg.norm(blended, axis=1) > np.linalg.norm(closing[near], axis=1)
        closing[near[larger]] = blended[larger]
    if rigid is not None:
        closing[rigid] = 0.0
    return closing.astype(np.float32)


def _along(edge: Array) -> Array:
    """Share of the way along an edge (N, 3) at each of its vertices (N,), 0 to 1."""
    steps = np.linalg.norm(np.diff(edge, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]) / max(float(steps.sum()), 1e-12)


def _ways(edge: Array, opposite: Array) -> Array:
    """From each vertex of an edge (N, 3) to the opposite edge, at the same share of the way along."""
    at, knots = _along(edge), _along(opposite)
    return np.stack([np.interp(at, knots, opposite[:, axis]) for axis in range(3)], axis=1) - edge


def _arch(edge: Array) -> Array:
    """1 in the middle of an edge, 0 at the corners (N,)."""
    return np.asarray(np.sin(np.pi * _along(edge)))
