"""Reading the meshes of single frames: vertices in the order of the file, and which triangles they form."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.topology import read_mesh

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
    try:
        lines = path.read_bytes().splitlines()
    except OSError as error:
        raise FaceDiffError(f"{path}: cannot be read ({error.strerror}); expected an OBJ mesh") from error
    # Not through trimesh: it leaves out vertices of textured meshes that no face uses, and takes much longer.
    points = [line[2:] for line in lines if line[:2] in (b"v ", b"v\t")]
    try:
        width = len(points[0].split()) if points else 3  # colours may follow the coordinates
        table = np.array([float(word) for word in b" ".join(points).split()]).reshape(len(points), width)
    except ValueError as error:
        raise FaceDiffError(f"{path}: not a readable OBJ mesh ({error}); write it anew") from error
    if not len(table) or width < 3:
        raise FaceDiffError(f"{path}: holds no vertices; expected an OBJ mesh with lines `v x y z`")
    text = b"\n".join(line for line in lines if line[:2] in (b"f ", b"f\t"))
    same = known is not None and known.face_text == text
    return FrameMesh(table[:, :3].copy(), known.faces if same and known else _faces(path, text, len(table)), text)


def _faces(path: Path, text: bytes, n_vertices: int) -> Faces | None:
    """Triangles (F, 3) of an OBJ's face lines; polygons become fans. None if there is none."""
    triangles = []
    try:
        for line in text.splitlines():
            corners = [int(word.partition(b"/")[0]) for word in line.split()[1:]]
            corners = [corner - 1 if corner > 0 else n_vertices + corner for corner in corners]
            triangles += [(corners[0], b, c) for b, c in zip(corners[1:-1], corners[2:], strict=True)]
    except (ValueError, IndexError) as error:
        raise FaceDiffError(f"{path}: not a readable OBJ mesh ({error}); write it anew") from error
    if not triangles:
        return None
    faces = np.array(triangles, np.int64)
    if faces.min() < 0 or faces.max() >= n_vertices:
        raise FaceDiffError(f"{path}: a face names a vertex that is not there; the file has {n_vertices} vertices")
    return faces


def differing_faces(one: Faces, other: Faces) -> int:
    """How many triangles two lists do not share; order of triangles and of their corners does not count."""
    first, second = (np.unique(np.sort(faces, axis=1), axis=0) for faces in (one, other))
    _, counts = np.unique(np.concatenate([first, second]), axis=0, return_counts=True)
    return int(np.count_nonzero(counts == 1))
