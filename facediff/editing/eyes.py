"""Where a face's eyelids and eyeballs are, and how the lids shut.

They are known for the built-in puppet, and are read from the user's file for any other topology.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, OptionError
from facediff.utils.arrays import open_array, read_arrays
from facediff.utils.numerics import smooth_step
from facediff.utils.plain_files import load_json

Array = npt.NDArray[np.float64]
Indices = npt.NDArray[np.int64]
Vertices = npt.NDArray[np.floating]

GIVE = (
    "give {eyes}: a file that says where lids and eyeballs are (docs/animation_controls.md shows one for FLAME and for "
    "any mesh)"
)
STILL = 0.01  # Vertices that a blink moves by less than this share of its largest way are left alone
MEET = 0.12  # Where the lids meet, from the lower (0) to the upper edge (1): the lower lid hardly rises in a blink
AHEAD = 0.025
"""The shut upper lid lies further out by this share of the eye's width: its way is straight, the eyeball is round."""
REACH = 0.4  # How far from the edges the skin follows, as a share of the eye's width
KEYS = ("neutral", "blinks", "lids", "eyeballs", "brows")
PLAUSIBLE = (0.002, 0.2)  # The largest way of a lid, as a share of the face's size (the diagonal of its box)
SAME_FACE = 1e-3  # Metres that a face may differ from a puppet's to count as that puppet's


@dataclass(frozen=True, eq=False)
class Eyes:
    """The eyes of a face."""

    # (V, 3) way from open to shut lids, in the face's unit; zero wherever a blink moves nothing. None if it is
    # not known
    closing: npt.NDArray[np.float32] | None
    eyeballs: tuple[Indices, ...]  # vertices of each eyeball
    source: str  # who says so, for messages
    brows: Indices | None = None  # vertices of both brows; None if nobody says

    def __post_init__(self) -> None:
        if self.closing is not None and not (np.isfinite(self.closing).all() and self.closing.any()):
            raise FaceDiffError(f"{self.source}: its blink moves nothing, or holds NaN; give the shape of shut eyes")
        if any(len(ball) < 4 for ball in self.eyeballs):
            raise FaceDiffError(f"{self.source}: an eyeball of less than four vertices has no centre; name all of them")

    def lids(self) -> tuple[Indices, npt.NDArray[np.float32]]:
        """The vertices (L,) that a blink moves, and their ways (L, 3); refused if the way is not known."""
        if self.closing is None:
            raise OptionError.naming(f"{self.source}: does not say how the lids shut; {GIVE}")
        way = np.linalg.norm(self.closing, axis=-1)
        chosen = np.flatnonzero(way > STILL * way.max())
        return chosen, self.closing[chosen]


def eyes_for(template: Vertices, faces: npt.NDArray[np.integer] | None, file: Path | None) -> Eyes | None:
    """The eyes of a face (V, 3): from the file if there is one, else the puppet's if it is a puppet, else None."""
    return read_eyes(file, template) if file is not None else puppet_eyes(template, faces)


def puppet_eyes(template: Vertices, faces: npt.NDArray[np.integer] | None) -> Eyes | None:
    """The eyes of a face (V, 3) of the built-in corpus, by the rig that its blinks are made with; None for others."""
    from facediff.synthetic.known_faces import known_face

    face = known_face(template, faces)
    if face is None:
        return None
    if face.distance <= SAME_FACE:
        closing = face.closing.astype(np.float32)
    else:  # another speaker's face on the puppet's mesh has no rig: the edges of its own lids say how they shut
        closing = closing_of_lids(template, face.lids, np.concatenate(face.eyeballs))
    return Eyes(closing, face.eyeballs, "the built-in puppet")


def read_eyes(path: Path, template: Vertices) -> Eyes:
    """The eyes of a face (V, 3) from a file.

    ``.json`` names shapes of shut eyes or lists the lids' edges, and lists the eyeballs::

        {"neutral": "neutral.obj", "blinks": ["eyeBlinkLeft.obj", "eyeBlinkRight.obj"],
         "eyeballs": ["FLAME_masks.pkl:left_eyeball", "FLAME_masks.pkl:right_eyeball"],
         "brows": ["brows.txt"]}

    ``.npz`` holds the same as arrays: ``closing`` (V, 3), ``neutral`` (V, 3), and ``brows`` and any ``eyeball…`` with
    indices.
    """
    if path.suffix.lower() == ".npz":
        arrays = read_arrays(path, name=f"eyes {path}")
        names = sorted(name for name in arrays if name.startswith("eyeball"))
        balls = tuple(_checked(path, arrays[name], len(template)) for name in names)
        closing, neutral = arrays.get("closing"), arrays.get("neutral")
        brows = _checked(path, arrays["brows"], len(template)) if "brows" in arrays else None
    else:
        closing, neutral, balls, brows = _read_json(path, template)
    if closing is None and not balls and brows is None:
        raise OptionError.naming(
            f"{{eyes}} {path}: says nothing of lids or eyeballs, nor of brows; known are {', '.join(KEYS)}"
        )
    if closing is None:
        return Eyes(None, balls, f"eyes {path}", brows)
    size = float(np.linalg.norm(np.ptp(template, axis=0)))
    if closing.shape != template.shape or (neutral is not None and neutral.shape != template.shape):
        raise OptionError.naming(f"{{eyes}} {path}: its blink has shape {closing.shape}; the face has {template.shape}")
    scale = 1.0 if neutral is None else size / max(float(np.linalg.norm(np.ptp(neutral, axis=0))), 1e-12)
    way = scale * float(np.linalg.norm(closing, axis=-1).max())
    if not PLAUSIBLE[0] * size < way < PLAUSIBLE[1] * size:
        raise OptionError.naming(
            f"{{eyes}} {path}: its blink moves a lid by {way:.3g} on a face of size {size:.3g}; give the shape of shut "
            f'eyes, and as "neutral" the open face in the same unit'
        )
    return Eyes(np.asarray(scale * closing, np.float32), balls, f"eyes {path}", brows)


def _read_json(
    path: Path, template: Vertices
) -> tuple[Vertices | None, Vertices | None, tuple[Indices, ...], Indices | None]:
    """How the lids shut, by shapes or by edges; the open face; eyeballs; brows. None where the file does not say."""
    content = load_json(path, name=f"eyes {path}")
    lids_fit = isinstance(content, dict) and all(
        isinstance(lid, dict) and {"upper", "lower"} <= lid.keys() for lid in content.get("lids", [])
    )
    if not lids_fit or not content.keys() <= set(KEYS):
        raise OptionError.naming(
            f"{{eyes}} {path}: expected an object with {', '.join(KEYS)} alone, all but the first of them lists, and "
            f'"lids" of {{"upper": …, "lower": …}}'
        )
    count = len(template)
    balls = tuple(_indices(path, listed, count) for listed in content.get("eyeballs", []))
    neutral = _read_shape(path, content["neutral"]) if "neutral" in content else None
    brows = None
    if listed := content.get("brows"):
        entries = listed if any(isinstance(entry, str | list) for entry in listed) else [listed]
        brows = np.unique(np.concatenate([_indices(path, entry, count) for entry in entries]))
    if content.get("blinks"):
        total: Vertices = np.zeros((count, 3))
        for name in content["blinks"]:
            shape = _read_shape(path, name)
            absolute = Path(name).suffix.lower() != ".npy"
            if len(shape) != count or (absolute and (neutral is None or len(neutral) != count)):
                raise OptionError.naming(
                    f'{{eyes}} {path}: "{name}" has {len(shape)} vertices and the face {count}; give the open face of '
                    f'the same mesh as "neutral"'
                )
            total = total + (shape - neutral if absolute and neutral is not None else shape)
        return total, neutral, balls, brows
    if content.get("lids"):
        edges = [(_indices(path, lid["upper"], count), _indices(path, lid["lower"], count)) for lid in content["lids"]]
        return closing_of_lids(template, edges, np.concatenate(balls) if balls else None), neutral, balls, brows
    return None, neutral, balls, brows


def _read_shape(path: Path, name: str) -> Vertices:
    """Vertices of a mesh, or displacements (V, 3) of a .npy file, that the eyes' file names."""
    from facediff.mesh import read_mesh

    file = path.parent / name
    if file.suffix.lower() != ".npy":
        return read_mesh(file).vertices
    array = open_array(file, kinds="f", name=f"eyes {path}: {file}")
    return np.asarray(array.reshape(-1, 3), np.float64)


def _indices(path: Path, listed: object, n_vertices: int) -> Indices:
    """Indices in their order: a list of them, a text file, or a mask of a pickle (``FLAME_masks.pkl:left_eyeball``)."""
    from facediff.mesh.flame import read_masks
    from facediff.metrics.regions import read_indices

    try:
        if not isinstance(listed, str):
            return _checked(path, np.asarray(listed), n_vertices)
        file, _, mask = listed.partition(":") if ".pkl:" in listed else (listed, "", "")
        read = read_masks(path.parent / file, mask) if file.endswith(".pkl") else read_indices(path.parent / file)
    except ValueError as error:
        raise OptionError.naming(f"{{eyes}} {path}: {error}") from error
    return _checked(path, np.asarray(read), n_vertices)


def _checked(path: Path, indices: npt.NDArray[Any], n_vertices: int) -> Indices:
    fit = indices.ndim == 1 and len(indices) and np.issubdtype(indices.dtype, np.integer)
    if not fit or not 0 <= indices.min() <= indices.max() < n_vertices:
        raise OptionError.naming(f"{{eyes}} {path}: expected lists of vertex indices from 0 to {n_vertices - 1}")
    return indices.astype(np.int64)


def closing_of_lids(
    template: Vertices, lids: list[tuple[Indices, Indices]], rigid: Indices | None = None
) -> npt.NDArray[np.float32]:
    """How the lids of a face (V, 3), y up and z to the viewer, shut: ways (V, 3) from the vertices of their edges.

    For each eye, the upper and the lower edge run from one corner to the other. Each edge vertex goes to the line
    between them at its own share of the way along; the skin around follows its nearest edge vertices, less and less up
    to 0.4 of the eye's width away. ``rigid`` vertices (eyeballs) do not follow.
    """
    places = np.asarray(template, np.float64)
    closing = np.zeros_like(places)
    for upper, lower in lids:
        top, bottom = places[upper], places[lower]
        # Edges may be listed from either corner of the eye: the lower one is made to begin where the upper one does.
        if np.linalg.norm(top[0] - bottom[0]) > np.linalg.norm(top[0] - bottom[-1]):
            lower, bottom = lower[::-1], bottom[::-1]
        width = max(float(np.linalg.norm(np.ptp(edge, axis=0))) for edge in (top, bottom))
        if min(len(top), len(bottom)) < 2 or width <= 0:
            raise FaceDiffError("lids: an edge needs two vertices at least, from one corner of the eye to the other")
        edge = np.concatenate([upper, lower])
        way = np.concatenate([(1.0 - MEET) * _ways(top, bottom), MEET * _ways(bottom, top)])
        # The straight way between the edges would lead through the eyeball, which bulges most in the middle.
        way[:, 2] += AHEAD * width * np.concatenate([_arch(top), 0.5 * _arch(bottom)])
        distance = np.linalg.norm(places[:, None] - places[edge], axis=-1)
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


def _ways(edge: Array, other: Array) -> Array:
    """From each vertex of an edge (N, 3) to the other edge, at the same share of the way along."""
    at, knots = _along(edge), _along(other)
    return np.stack([np.interp(at, knots, other[:, axis]) for axis in range(3)], axis=1) - edge


def _arch(edge: Array) -> Array:
    """1 in the middle of an edge, 0 at the corners (N,)."""
    return np.asarray(np.sin(np.pi * _along(edge)))
