"""Blendshapes on disk: a folder of meshes, ICT-FaceKit's folder among them, or a .glb with named targets."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from facediff.errors import FaceDiffError, damaged
from facediff.mesh import read_mesh
from facediff.mesh.glb import open_glb
from facediff.mesh.glb_shapes import read_targets
from facediff.spaces.arkit import arkit_name, plain
from facediff.utils.numerics import Floats, Integers

NEUTRAL = ("neutral", "basis", "rest", "base", "template", "genericneutralmesh")
"""Names (without case and punctuation) of the face at rest in a set of shapes."""

ICT_NEUTRAL = "genericneutralmesh"
"""The face at rest in ICT-FaceKit's folder (FaceXModel); its lengths are centimetres."""
HALVED = ("browInnerUp", "cheekPuff")
"""Shapes that ICT-FaceKit has as halves and ARKit as one."""
SUFFIXES = (".obj", ".ply")


@dataclass(frozen=True, eq=False)
class ShapeFiles:
    """Shapes as read, in their own topology, unit and axes."""

    path: Path  # the folder or the file
    first: Path  # the file to name where the topology is wrong
    names: tuple[str, ...]  # K names as written
    shapes: Floats  # (K, V, 3) vertices of each shape
    neutral: Floats | None  # (V, 3) the face at rest; None if there is none
    faces: Integers | None  # (F, 3) triangles; None if there are none
    metric: bool = False  # whether lengths are in metres by definition of the format, as in .glb
    rest: str = ""  # name of the file with the face at rest
    notes: tuple[str, ...] = ()  # changes since reading, a sentence each

    @property
    def arkit_names(self) -> tuple[str, ...]:
        """The names in ARKit's spelling where they are ARKit's; refused if two are the same."""
        names = tuple(arkit_name(name) or name for name in self.names)
        folded = [name.casefold() for name in names]
        if double := next((name for name, key in zip(names, folded, strict=True) if folded.count(key) > 1), None):
            raise FaceDiffError(f"{self.path}: has the shape {double} in two spellings; keep one of them")
        return names


def read_shape_files(path: Path, vertices: int | None = None) -> ShapeFiles:
    """Read a folder of meshes or a .glb.

    Args:
        path: the folder or file.
        vertices: of the mesh that they are for, by which the parts of a .glb are chosen; None for all that have shapes.
    """
    if path.suffix.lower() == ".glb":
        with damaged(path, "not a readable .glb with shapes, export it again"):
            targets = read_targets(open_glb(path), vertices)
        points = targets.neutral + targets.deltas
        return ShapeFiles(path, path, targets.names, points, targets.neutral, targets.faces, True, path.name)
    files = path.iterdir() if path.is_dir() else []
    candidates = sorted(f for f in files if f.suffix.lower() in SUFFIXES and not f.name.startswith("."))
    if any(plain(file.stem) == ICT_NEUTRAL for file in candidates):
        # Next to its expressions ICT-FaceKit keeps a hundred heads of other people.
        candidates = [file for file in candidates if not re.fullmatch(r"identity\d+", file.stem)]
    rest = [file for file in candidates if plain(file.stem) in NEUTRAL]
    shapes = [file for file in candidates if file not in rest]
    if len(rest) > 1 or not shapes:
        raise FaceDiffError(
            f"{path}: {'' if path.is_dir() else 'no such folder; it '}holds {len(shapes)} shapes and {len(rest)} faces "
            f"at rest; expected .obj or .ply files named jawOpen, mouthFunnel … and at most one neutral"
        )
    files = [*rest, *shapes]
    meshes = [read_mesh(file, points_allowed=True) for file in files]
    first = meshes[0]
    for file, mesh in zip(files, meshes, strict=True):
        retriangulated = len(first.faces) and len(mesh.faces) and not np.array_equal(mesh.faces, first.faces)
        if retriangulated or len(mesh.vertices) != len(first.vertices):
            raise FaceDiffError(
                f"{file}: has {len(mesh.vertices)} vertices, or other triangles, and {files[0].name} "
                f"{len(first.vertices)}; expected shapes of one mesh with the order of its vertices kept"
            )
    names, moves, notes = [file.stem for file in shapes], [mesh.vertices for mesh in meshes[len(rest) :]], []
    if rest and plain(rest[0].stem) == ICT_NEUTRAL:
        joined = dict(zip(names, moves, strict=True))
        for name in HALVED:
            halves = [f"{name}_L", f"{name}_R"]
            if all(half in joined for half in halves):
                joined[name] = joined.pop(halves[0]) + joined.pop(halves[1]) - first.vertices
                notes.append(f"{name} is the sum of its halves {' and '.join(halves)}")
        names, moves = list(joined), list(joined.values())
    return ShapeFiles(
        path,
        files[0],
        tuple(names),
        np.stack(moves),
        first.vertices if rest else None,
        first.faces if len(first.faces) else None,
        rest=rest[0].name if rest else "",
        notes=tuple(notes),
    )
