"""What programs that animate the built-in faces must know of them: speakers, lids, eyeballs, brows and shapes.

There are two topologies, one for each edition of the corpus.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from facediff.errors import FaceDiffError, choices
from facediff.spaces.arkit import ARKIT
from facediff.spaces.rigs import LinearRig
from facediff.synthetic import arkit, corpus, second_edition
from facediff.synthetic.cast import CAST
from facediff.synthetic.face import N_VERTICES, build_face
from facediff.synthetic.geometry import Array, HeadMesh
from facediff.synthetic.head.mesh import QuadMesh
from facediff.synthetic.head.parts import N_HEAD_VERTICES, build_head
from facediff.synthetic.head.rig import SHAPES, head_shapes
from facediff.synthetic.rig import LINEAR_FIELDS
from facediff.synthetic.speakers import SPEAKERS
from facediff.utils.files import atomic_folder

Index = NDArray[np.int64]


@dataclass(frozen=True)
class KnownFace:
    """The speaker of the built-in corpus that a face is most like; lengths in metres.

    Attributes:
        speaker: name of the speaker.
        distance: largest distance of a vertex from the speaker's.
        lids: vertices of the upper and the lower lid's edge from one corner to the other, of both eyes.
        eyeballs: vertices of each eyeball.
        closing: way of each vertex in a blink of the speaker, (V, 3).
        brows_up, brows_down: the same for raised and for lowered brows.
    """

    speaker: str
    distance: float
    lids: list[tuple[Index, Index]]
    eyeballs: tuple[Index, Index]
    closing: Array
    brows_up: Array
    brows_down: Array


def known_face(template: NDArray[np.floating], faces: NDArray[np.integer] | None) -> KnownFace | None:
    """What is known of a face (V, 3) in metres with triangles (F, 3); None if it has neither edition's topology."""
    edition = None if faces is None else edition_of_mesh(len(template), faces)
    if edition is None:
        return None
    # Templates pass through float32, and through files that round them, hence a distance instead of equality.
    distances = {name: float(np.abs(rest - template).max()) for name, rest in resting_faces(edition).items()}
    speaker = min(distances, key=lambda name: distances[name])
    mesh: HeadMesh | QuadMesh
    prefixes: tuple[str, ...]
    if edition == 1:
        mesh = build_face()
        prefixes, edge = ("eyeball", "pupil"), "eye_0"
        fields = dict(zip(LINEAR_FIELDS, corpus.rig_of(speaker).fields, strict=True))
        ways = [["lids_close"], ["inner_brow_up", "outer_brow_up"], ["brow_frown"]]
    else:
        mesh = build_head()
        prefixes, edge = ("ball_", "iris_", "pupil", "glint"), "eye_edge"
        fields = dict(zip(SHAPES, second_edition.rig_of(speaker)[1:], strict=True))
        ways = [["eyeBlink"], ["browInnerUp", "browOuterUp"], ["browDown"]]
    moves = [np.sum([field for name, field in fields.items() if name.startswith(tuple(way))], axis=0) for way in ways]
    # Both eyes' loops run from the inner corner over the upper lid to the outer one, and back below.
    loop, half = mesh.groups[edge], len(mesh.groups[edge]) // 2
    upper, lower = loop[: half + 1], np.concatenate([loop[:1], loop[: half - 1 : -1]])
    left = np.unique(np.concatenate([index for name, index in mesh.groups.items() if name.startswith(prefixes)]))
    return KnownFace(
        speaker,
        distances[speaker],
        [(upper, lower), (mesh.mirror[upper], mesh.mirror[lower])],
        (left, np.sort(mesh.mirror[left])),
        *moves,
    )


def edition_of_mesh(vertices: int, faces: NDArray[np.integer] | None = None) -> int | None:
    """The edition whose topology a mesh has, by its triangles too where they are known."""
    if vertices == N_VERTICES:
        own, edition = build_face().faces, 1
    elif vertices == N_HEAD_VERTICES:
        own, edition = build_head().faces, 2
    else:
        return None
    return edition if faces is None or np.array_equal(np.asarray(faces), own) else None


@lru_cache(maxsize=2)
def resting_faces(edition: int) -> Mapping[str, Array]:
    """Each speaker's face at rest (V, 3), drawn speakers aside."""
    if edition == 1:
        return {name: speaker.shape(build_face().vertices) for name, speaker in SPEAKERS.items()}
    return {name: second_edition.resting_head(member) for name, member in CAST.items()}


def built_in_shapes(speaker: str | None = None, edition: int = 2) -> tuple[Array, Index, dict[str, Array]]:
    """A built-in face at rest (V, 3) in metres, its triangles, and its shapes by ARKit's names, each (V, 3).

    Args:
        speaker: a speaker of the edition; the average face if None.
        edition: 1 or 2.
    """
    if edition == 1:
        return arkit.puppet_shapes(speaker)
    if speaker is not None and speaker not in CAST:
        raise FaceDiffError(f'--identity: there is no speaker "{speaker}"; {choices(speaker, CAST)}')
    mesh = build_head()
    if speaker is None:
        rest, fields = mesh.vertices / 1000.0, [head_shapes()[name] / 1000.0 for name in SHAPES]
    else:
        rest, *fields = second_edition.rig_of(speaker).astype(np.float64)
    shapes = {name: rest + field for name, field in zip(SHAPES, fields, strict=True) if name in ARKIT}
    return rest, np.asarray(mesh.faces, np.int64), shapes


def built_in_rig(speaker: str | None = None, edition: int = 2) -> LinearRig:
    """The rig of a built-in face; the arguments are those of :func:`built_in_shapes`."""
    rest, faces, shapes = built_in_shapes(speaker, edition)
    deltas = np.stack([vertices - rest for vertices in shapes.values()])
    return LinearRig(tuple(shapes), rest, deltas, faces, "m", f"puppet {edition}" + (f" {speaker}" if speaker else ""))


def write_puppet_shapes(folder: Path, speaker: str | None = None, edition: int = 2) -> list[str]:
    """Write the shapes as OBJ files, and the face at rest as ``neutral.obj``; the folder appears whole or not at all.

    Returns:
        the names of the shapes.
    """
    if folder.exists():
        raise FaceDiffError(f"{folder}: exists already; choose a new folder")
    neutral, faces, shapes = built_in_shapes(speaker, edition)
    triangles = "".join(f"f {a} {b} {c}\n" for a, b, c in faces + 1)
    with atomic_folder(folder) as temporary:
        for name, vertices in {"neutral": neutral, **shapes}.items():
            points = "".join(f"v {x:.9f} {y:.9f} {z:.9f}\n" for x, y, z in vertices)
            (temporary / f"{name}.obj").write_text(points + triangles, encoding="ascii")
    return list(shapes)
