"""Blendshapes on disk: a folder of meshes, or a glb with named targets."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.blendshapes.arkit import NEUTRAL, plain
from facediff.errors import FaceDiffError
from facediff.topology import read_mesh
from facediff.topology.obj import read_obj

SUFFIXES = (".obj", ".ply")


@dataclass(frozen=True, eq=False)
class ShapeFiles:
    """Shapes as read, whatever their topology, unit and axes.

    Attributes:
        path: the folder or the file.
        first: the file to name where the topology is wrong.
        names: K names as written.
        shapes: (K, V, 3) vertices of each shape.
        neutral: (V, 3) the face at rest; None if there is none.
        faces: (F, 3) triangles; None if there are none.
        metric: whether lengths are in metres by prescription, as in glb.
        rest: name of the file with the face at rest.
        notes: what was found on reading.
    """

    path: Path
    first: Path
    names: tuple[str, ...]
    shapes: npt.NDArray[np.floating]
    neutral: npt.NDArray[np.floating] | None
    faces: npt.NDArray[np.integer] | None
    metric: bool = False
    rest: str = ""
    notes: tuple[str, ...] = field(default=())


def read_shape_files(path: Path) -> ShapeFiles:
    """Read a folder of meshes or a glb.

    Raises:
        FaceDiffError: if it is missing or damaged, holds no shapes, or its meshes differ in topology or vertex order.
    """
    if path.suffix.lower() == ".glb":
        from facediff.blendshapes.glb import read_glb_targets

        mesh = read_glb_targets(path)
        return ShapeFiles(
            path, path, mesh.names, mesh.neutral + mesh.deltas, mesh.neutral, mesh.faces, metric=True, rest=path.name
        )
    if not path.is_dir():
        raise FaceDiffError(f"{path}: no such folder; expected one of .obj or .ply files, or a .glb with named targets")
    found = sorted(f for f in path.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    rest = [file for file in found if plain(file.stem) in NEUTRAL]
    if len(rest) > 1:
        raise FaceDiffError(f"{path}: {rest[0].name} and {rest[1].name} are both the face at rest; keep one of them")
    shapes = [file for file in found if file not in rest]
    if not shapes:
        raise FaceDiffError(f"{path}: holds no shapes; expected .obj or .ply files named jawOpen, mouthFunnel …")
    meshes = _read_alike([*rest, *shapes])
    points = np.stack([vertices for vertices, _ in meshes])
    return ShapeFiles(
        path,
        (rest or shapes)[0],
        tuple(file.stem for file in shapes),
        points[len(rest) :],
        points[0] if rest else None,
        meshes[0][1],
        rest=rest[0].name if rest else "",
    )


def _read_alike(files: list[Path]) -> list[tuple[npt.NDArray[np.float64], npt.NDArray[np.integer] | None]]:
    """Vertices and triangles of each file; all must have the first one's topology."""
    meshes: list[tuple[npt.NDArray[np.float64], npt.NDArray[np.integer] | None]] = []
    text = None
    for file in files:
        if file.suffix.lower() == ".obj":
            obj = read_obj(file)
            # Equal lines are equal triangles, and reading them takes longest.
            same = text is not None and obj.face_text == text
            meshes.append((obj.vertices, meshes[0][1] if same else obj.faces))
            text = obj.face_text if len(meshes) == 1 else text
        else:
            mesh = read_mesh(file)
            meshes.append((mesh.vertices, mesh.faces))
        (first, faces), (vertices, triangles) = meshes[0], meshes[-1]
        if len(vertices) != len(first):
            raise FaceDiffError(
                f"{file}: has {len(vertices)} vertices and {files[0].name} {len(first)}; expected shapes of one mesh"
            )
        if faces is not None and triangles is not None and not np.array_equal(faces, triangles):
            raise FaceDiffError(
                f"{file}: its triangles are not those of {files[0].name}; expected shapes of one mesh with the order "
                f"of its vertices kept"
            )
        if not np.isfinite(vertices).all():
            raise FaceDiffError(f"{file}: holds NaN or infinity; write it anew")
    return meshes
