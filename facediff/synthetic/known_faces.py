"""Lids, eyeballs, brows, shapes and speakers of the built-in head, for programs that animate it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facediff.errors import check_known
from facediff.spaces.arkit import ARKIT
from facediff.spaces.rigs import LinearRig
from facediff.synthetic.cast import CAST
from facediff.synthetic.corpus import resting_head, rig_of
from facediff.synthetic.geometry import Array
from facediff.synthetic.head.parts import N_HEAD_VERTICES, build_head
from facediff.synthetic.head.rig import SHAPES, head_shapes
from facediff.utils.files import atomic_folder

Index = NDArray[np.int64]


@dataclass(frozen=True)
class KnownFace:
    """The speaker of the built-in corpus that a face is most like; lengths in metres.

    Attributes:
        distance: largest distance of a vertex from the speaker's.
        lids: vertices of the upper and the lower lid's edge from one corner to the other, of both eyes.
        eyeballs: vertices of each eyeball.
        closing, brows_up, brows_down: way of each vertex (V, 3) in a blink and with raised and lowered brows.
    """

    speaker: str
    distance: float
    lids: list[tuple[Index, Index]]
    eyeballs: tuple[Index, Index]
    closing: Array
    brows_up: Array
    brows_down: Array


def known_face(template: NDArray[np.floating], faces: NDArray[np.integer] | None) -> KnownFace | None:
    """The speaker of a face (V, 3) in metres with triangles (F, 3); None if it is not the built-in head."""
    if faces is None or not is_built_in(len(template), faces):
        return None
    # Templates pass through float32, and through files that round them, hence a distance instead of equality.
    distances = {name: float(np.abs(rest - template).max()) for name, rest in resting_heads().items()}
    speaker = min(distances, key=lambda name: distances[name])
    mesh, displacements = build_head(), dict(zip(SHAPES, rig_of(speaker)[1:], strict=True))
    closing, brows_up, brows_down = (
        np.sum([move for name, move in displacements.items() if name.startswith(prefixes)], axis=0)
        for prefixes in ("eyeBlink", ("browInnerUp", "browOuterUp"), "browDown")
    )
    # Both eyes' loops run from the inner corner over the upper lid to the outer one, and back below.
    loop, half = mesh.groups["eye_edge"], len(mesh.groups["eye_edge"]) // 2
    upper, lower = loop[: half + 1], np.concatenate([loop[:1], loop[: half - 1 : -1]])
    parts = [index for name, index in mesh.groups.items() if name.startswith(("ball_", "iris_", "pupil", "glint"))]
    left = np.unique(np.concatenate(parts))
    return KnownFace(
        speaker,
        distances[speaker],
        [(upper, lower), (mesh.mirror[upper], mesh.mirror[lower])],
        (left, np.sort(mesh.mirror[left])),
        closing,
        brows_up,
        brows_down,
    )


def is_built_in(vertices: int, faces: NDArray[np.integer] | None = None) -> bool:
    """Whether a mesh has the built-in head's topology, by its triangles too where they are known."""
    # Files of version 1 have some of its parts inside out: the triangles count, and not which way round they are.
    return vertices == N_HEAD_VERTICES and (
        faces is None or np.array_equal(np.sort(faces, axis=1), np.sort(build_head().faces, axis=1))
    )


@lru_cache(maxsize=1)
def resting_heads() -> Mapping[str, Array]:
    """Each speaker's head at rest (V, 3), drawn speakers aside."""
    return {name: resting_head(member) for name, member in CAST.items()}


def built_in_shapes(speaker: str | None = None) -> tuple[Array, Index, dict[str, Array]]:
    """A speaker's head (the average one if None) at rest (V, 3) in metres, its triangles, and ARKit's shapes (V, 3)."""
    check_known("--identity", "speaker", [] if speaker is None else [speaker], CAST)
    mesh = build_head()
    if speaker is None:
        rest, fields = mesh.vertices / 1000.0, [head_shapes()[name] / 1000.0 for name in SHAPES]
    else:
        rest, *fields = rig_of(speaker).astype(np.float64)
    shapes = {name: rest + field for name, field in zip(SHAPES, fields, strict=True) if name in ARKIT}
    return rest, np.asarray(mesh.faces, np.int64), shapes


def built_in_rig(speaker: str | None = None) -> LinearRig:
    """The rig of a built-in head; the argument is as for :func:`built_in_shapes`."""
    rest, faces, shapes = built_in_shapes(speaker)
    deltas = np.stack([vertices - rest for vertices in shapes.values()])
    # The 2 is the edition, and part of the identity that files hold.
    return LinearRig(tuple(shapes), rest, deltas, faces, "m", "puppet 2" + (f" {speaker}" if speaker else ""))


def write_puppet_shapes(folder: Path, speaker: str | None = None) -> list[str]:
    """Write the shapes as OBJ files, and the face at rest as ``neutral.obj``; gives the names of the shapes."""
    neutral, faces, shapes = built_in_shapes(speaker)
    triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    with atomic_folder(folder) as temporary:
        for name, vertices in {"neutral": neutral, **shapes}.items():
            points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
            (temporary / f"{name}.obj").write_text(points + triangles, encoding="ascii")
    return list(shapes)
