"""Reading the meshes of single frames: vertices in the order of the file, and which triangles they form."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.topology import read_mesh
from facediff.topology.obj import read_obj

Faces = npt.NDArray[np.int64]

MESHES = (".obj", ".ply")


@dataclass(frozen=True)
class FrameMesh:
    """A mesh as read.

    Attributes:
        vertices: (V, 3) float64.
        faces: (F, 3) vertex indices; None if the file has none.
        face_text: the lines of an OBJ's faces, by which equal faces are told without reading them; empty otherwise.
    """

    vertices: npt.NDArray[np.float64]
    faces: Faces | None
    face_text: bytes = b""


def read_frame_mesh(path: Path, *, known: FrameMesh | None = None) -> FrameMesh:
    """Read an OBJ or PLY file.

    Args:
        path: the file.
        known: a mesh read before; where the lines of the faces are the same, its faces are taken.

    Raises:
        FaceDiffError: if the file is missing or damaged, or holds no vertex.
        MissingExtraError: if a PLY file is to be read and trimesh is not installed.
    """
    if path.suffix.lower() != ".obj":
        mesh = read_mesh(path)
        return FrameMesh(mesh.vertices, mesh.faces.astype(np.int64))
    obj = read_obj(path)
    same = known is not None and known.face_text == obj.face_text
    return FrameMesh(obj.vertices, known.faces if same and known else obj.faces, obj.face_text)


def differing_faces(one: Faces, other: Faces) -> int:
    """How many triangles two lists do not share; order of triangles and of their corners does not count."""
    first, second = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (one, other))
    _, counts = np.unique(np.concatenate([first, second]), axis=0, return_counts=True)
    return int(np.count_nonzero(counts == 1))
