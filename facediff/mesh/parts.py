"""The named parts of a mesh file: nodes, meshes and materials of a .glb; objects, groups and materials of an OBJ."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from pathlib import Path

import numpy as np

from facediff.errors import OptionError, choices, damaged
from facediff.mesh.glb import open_glb
from facediff.mesh.glb_scene import placed_parts
from facediff.utils.numerics import Indices
from facediff.utils.plain_files import read_bytes

NAMING = {b"o": 0, b"g": 1, b"usemtl": 2}


@dataclass(frozen=True, eq=False)
class MeshPart:
    """Triangles that have names in common."""

    names: tuple[str, ...]
    triangles: Indices  # numbers of the triangles of the mesh that `read_mesh` reads


def mesh_parts(path: Path) -> list[MeshPart]:
    """The parts of a file that :func:`facediff.mesh.read_mesh` reads; none for formats that have no names."""
    runs: list[tuple[tuple[str, ...], int]] = []
    with damaged(path, "export it again"):
        if path.suffix.lower() == ".glb":
            runs = [(part.names, len(part.faces)) for part in placed_parts(open_glb(path))]
        elif path.suffix.lower() == ".obj":
            runs = _obj_parts(read_bytes(path, remedy="expected a mesh"))
    parts, before = [], 0
    for names, count in runs:
        parts.append(MeshPart(names, np.arange(before, before + count)))
        before += count
    return parts


def named_triangles(path: Path, names: Sequence[str]) -> Indices:
    r"""The triangles of a file's mesh that lie in parts with these names; ``*`` stands for any letters.

    Example:
        >>> import tempfile
        >>> path = Path(tempfile.mkdtemp()) / "two.obj"
        >>> _ = path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\no Head\nf 1 2 3\no Hat\nf 1 3 4\n")
        >>> named_triangles(path, ["Hat"])
        array([1])
    """
    parts = mesh_parts(path)
    part_names = list(dict.fromkeys(name for part in parts for name in part.names))
    triangles = []
    for pattern in names:
        stars = pattern.replace("[", "[[]").replace("?", "[?]")  # other signs stand for themselves
        for fold in (str, str.casefold):  # another case counts only where nothing is written so
            matching = [part for part in parts if any(fnmatchcase(fold(name), fold(stars)) for name in part.names)]
            if matching:
                break
        else:
            advice = choices(pattern, part_names) if part_names else "its parts have no names, so omit {part}"
            raise OptionError.naming(f'{path}: has no part "{pattern}"; {advice}')
        triangles += [part.triangles for part in matching]
    return np.unique(np.concatenate(triangles))


def _obj_parts(data: bytes) -> list[tuple[tuple[str, ...], int]]:
    """Names and number of triangles of each run of faces."""
    runs: list[tuple[tuple[str, ...], int]] = []
    current = ["", "", ""]
    for line in data.splitlines():
        cells = line.split()
        if not cells:
            continue
        if cells[0] in NAMING:
            current[NAMING[cells[0]]] = b" ".join(cells[1:]).decode("utf-8", "replace")
        elif cells[0] == b"f":
            names = tuple(dict.fromkeys(name for name in current if name))
            if not runs or runs[-1][0] != names:
                runs.append((names, 0))
            runs[-1] = (names, runs[-1][1] + len(cells) - 3)
    return runs
