"""Reading template meshes."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.topology.obj import read_obj

SUFFIXES = (".ply", ".obj", ".stl", ".off", ".glb")


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh.

    Attributes:
        vertices: (V, 3) positions, in the order of the file.
        faces: (F, 3) vertex indices.
        colours: (V, 3) vertex colours, sRGB; None if the file has none.
    """

    vertices: npt.NDArray[np.float64]
    faces: npt.NDArray[np.int32]
    colours: npt.NDArray[np.uint8] | None = None


def read_mesh(path: Path) -> Mesh:
    """Read a mesh without merging, dropping or reordering a vertex.

    Raises:
        FaceDiffError: if the file is missing, unreadable or holds no triangles.
        MissingExtraError: if trimesh is not installed.
    """
    if not path.is_file():
        raise FaceDiffError(f"{path}: no such mesh file; expected one of {', '.join(SUFFIXES)}")
    if path.suffix.lower() == ".obj":
        return _read_obj(path)
    try:
        import trimesh
    except ImportError as error:
        raise MissingExtraError("trimesh", "train", "reading a mesh") from error
    try:
        mesh = trimesh.load(path, process=False, maintain_order=True, force="mesh")
    except Exception as error:
        raise FaceDiffError(f"{path}: not a readable mesh ({error}); expected PLY or OBJ with triangles") from error
    if not len(mesh.faces):
        raise FaceDiffError(f"{path}: holds no triangles; expected a mesh with faces")
    coloured = mesh.visual.kind == "vertex"
    return Mesh(
        np.array(mesh.vertices, np.float64),
        np.array(mesh.faces, np.int32),
        np.array(mesh.visual.vertex_colors[:, :3], np.uint8) if coloured else None,
    )


def _read_obj(path: Path) -> Mesh:
    obj = read_obj(path)
    if obj.faces is None:
        raise FaceDiffError(f"{path}: holds no triangles; expected a mesh with faces")
    colours = None if obj.colours is None else np.rint(obj.colours.clip(0, 1) * 255).astype(np.uint8)
    return Mesh(obj.vertices, obj.faces.astype(np.int32), colours)
