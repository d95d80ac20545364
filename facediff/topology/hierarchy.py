"""A mesh, the same mesh with fewer and fewer vertices, and the maps between them: made once per topology and kept."""

from __future__ import annotations

import hashlib
import json
import zipfile
import zlib
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.files import atomic, cache_dir
from facediff.topology.coarsening import Operator, Pooling, checked_template, coarsen
from facediff.topology.spirals import Indices, Points, checked_faces, spirals

VERSION = 1
"""Part of every key in the cache; to be raised whenever equal input gives another result."""


@dataclass(frozen=True)
class MeshLevel:
    """One resolution of a mesh.

    Attributes:
        n_vertices: its vertices.
        faces: (F, 3) vertex indices.
        spirals: (n_vertices, length) every vertex and those around it.
        down: map to the next, coarser level; None at the coarsest.
        up: map from the next level to this one; None at the coarsest.
    """

    n_vertices: int
    faces: Indices
    spirals: Indices
    down: Operator | None
    up: Operator | None


@dataclass(frozen=True)
class MeshHierarchy:
    """A mesh at several resolutions.

    Attributes:
        n_vertices: vertices of the whole template.
        vertices: those of the template that the finest level consists of, ascending; None if it has all of them.
        levels: finest first; one more than the number of down-samplings.
    """

    n_vertices: int
    vertices: Indices | None
    levels: tuple[MeshLevel, ...]

    def arrays(self) -> dict[str, npt.NDArray[Any]]:
        """All of it as named plain arrays, from which :meth:`from_arrays` makes an equal one."""
        named: dict[str, npt.NDArray[Any]] = {"n_vertices": np.array(self.n_vertices)}
        if self.vertices is not None:
            named["vertices"] = self.vertices.astype(np.int32)
        for number, level in enumerate(self.levels):
            named[f"{number}.faces"] = level.faces.astype(np.int32)
            named[f"{number}.spirals"] = level.spirals.astype(np.int32)
            for name, operator in (("down", level.down), ("up", level.up)):
                if operator is not None:
                    named[f"{number}.{name}.rows"] = operator.rows.astype(np.int32)
                    named[f"{number}.{name}.columns"] = operator.columns.astype(np.int32)
                    named[f"{number}.{name}.weights"] = operator.weights
        return named

    @classmethod
    def from_arrays(cls, named: Mapping[str, npt.ArrayLike]) -> MeshHierarchy:
        """The hierarchy that :meth:`arrays` described.

        Raises:
            FaceDiffError: if an array is missing or does not fit the others.
        """
        try:
            arrays = {name: np.asarray(array) for name, array in named.items()}
            sizes: list[int] = []
            while f"{len(sizes)}.spirals" in arrays:
                sizes.append(len(arrays[f"{len(sizes)}.spirals"]))
            levels = tuple(_level(arrays, number, sizes) for number in range(len(sizes)))
            vertices = arrays["vertices"].astype(np.int64) if "vertices" in arrays else None
            n_vertices = int(arrays["n_vertices"])
            if not levels or sizes[0] != (n_vertices if vertices is None else len(vertices)):
                raise ValueError("levels")
        except (KeyError, ValueError, IndexError, TypeError) as error:
            raise FaceDiffError(
                f"mesh hierarchy: its arrays are not complete or do not fit one another ({error}); make it anew from "
                f"the template"
            ) from error
        return cls(n_vertices, vertices, levels)


def mesh_hierarchy(
    template: Points,
    faces: npt.NDArray[np.integer],
    levels: int = 3,
    factor: int = 4,
    spiral_length: int = 12,
    dilation: int = 1,
    pooling: Pooling = "select",
    vertices: npt.NDArray[np.integer] | None = None,
    cache: Path | None = None,
) -> MeshHierarchy:
    """A mesh and ``levels`` coarser ones, each with a ``factor``-th of the vertices (rounded up) of the one before.

    Numbers of vertices depend on V, ``factor`` and ``levels`` alone. The result is kept in a file under the hash of
    everything it depends on; a damaged file is written anew, and without a folder to write to nothing is kept.

    Args:
        template: (V, 3) positions in any unit; used in float32, as the hash is.
        faces: (F, 3) vertex indices.
        levels: down-samplings.
        factor: vertices of a level to one of the next.
        spiral_length: vertices of a spiral, its centre included.
        dilation: distance along the spiral between two of them.
        pooling: whether a coarse vertex is one vertex of its cluster or the cluster's mean.
        vertices: the vertices to use (e.g. a face without its eyeballs), an index set; all if None. Faces with a
            corner elsewhere are left out.
        cache: folder of the files; ``topology`` in facediff's cache if None.

    Raises:
        FaceDiffError: if template, faces, vertices or a number is not as described.
        MissingExtraError: if the simplifier is not installed.
    """
    template = checked_template(np.asarray(template, np.float32))
    faces = checked_faces(faces, len(template))
    if levels < 0 or factor < 1 or spiral_length < 1 or dilation < 1 or pooling not in ("select", "mean"):
        raise FaceDiffError(
            f"mesh hierarchy: levels {levels}, factor {factor}, spiral_length {spiral_length}, dilation {dilation}, "
            f'pooling "{pooling}"; expected levels from 0, the other numbers from 1, and pooling select or mean'
        )
    chosen = None if vertices is None else _checked_vertices(vertices, len(template))
    key = _key(template, faces, chosen, [levels, factor, spiral_length, dilation, pooling])
    path = (cache or cache_dir() / "topology") / f"{key}.npz"
    kept = _read(path)
    if kept is not None:
        return kept
    points, inner = (template, faces) if chosen is None else submesh(template, faces, chosen)
    made = []
    for _ in range(levels):
        coarse = coarsen(points, inner, -(-len(points) // factor), pooling)
        table = spirals(inner, len(points), spiral_length, dilation, points)
        made.append(MeshLevel(len(points), inner, table, coarse.down, coarse.up))
        points, inner = coarse.template, coarse.faces
    table = spirals(inner, len(points), spiral_length, dilation, points)
    made.append(MeshLevel(len(points), inner, table, None, None))
    hierarchy = MeshHierarchy(len(template), chosen, tuple(made))
    with suppress(FaceDiffError), atomic(path) as temporary:  # what cannot be kept is made again next time
        np.savez(temporary, allow_pickle=False, **hierarchy.arrays())
    return hierarchy


def submesh(template: Points, faces: Indices, vertices: Indices) -> tuple[npt.NDArray[np.float64], Indices]:
    """Some vertices of a mesh (ascending indices), and the faces all of whose corners are among them."""
    place = np.full(len(template), -1)
    place[vertices] = np.arange(len(vertices))
    kept = place[faces]
    return np.asarray(template, np.float64)[vertices], kept[(kept >= 0).all(axis=1)]


def _checked_vertices(vertices: npt.NDArray[np.integer], n_vertices: int) -> Indices:
    chosen = np.asarray(vertices)
    if chosen.ndim != 1 or not len(chosen) or chosen.dtype.kind not in "iu":
        raise FaceDiffError(f"vertices: {chosen.dtype} of shape {chosen.shape}; expected a list of vertex indices")
    chosen = np.unique(chosen.astype(np.int64))
    if chosen[0] < 0 or chosen[-1] >= n_vertices:
        raise FaceDiffError(
            f"vertices: indices from {chosen[0]} to {chosen[-1]}, but the template has {n_vertices} vertices"
        )
    return chosen


def _key(template: Points, faces: Indices, vertices: Indices | None, options: list[int | str]) -> str:
    """Hash of all that a hierarchy depends on."""
    try:
        library = version("fast-simplification")
    except PackageNotFoundError:
        library = "none"
    shapes = [len(template), len(faces), -1 if vertices is None else len(vertices)]
    digest = hashlib.sha256(json.dumps([VERSION, library, shapes, options]).encode())
    digest.update(template.astype("<f4").tobytes())
    digest.update(faces.astype("<i8").tobytes())
    if vertices is not None:
        digest.update(vertices.astype("<i8").tobytes())
    return digest.hexdigest()


def _read(path: Path) -> MeshHierarchy | None:
    """The hierarchy in a file; None if there is none or the file is damaged."""
    try:
        # Opened here, since NumPy leaves a file open that turns out to be no archive.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as stored:
            return MeshHierarchy.from_arrays(dict(stored))
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error, FaceDiffError):
        return None


def _level(arrays: Mapping[str, npt.NDArray[Any]], number: int, sizes: list[int]) -> MeshLevel:
    """Raises KeyError or ValueError if an array is missing or an index is out of its range."""
    size = sizes[number]
    table, faces = (_within(arrays[f"{number}.{name}"], size, 2) for name in ("spirals", "faces"))
    if number + 1 == len(sizes):
        return MeshLevel(size, faces, table, None, None)
    coarse = sizes[number + 1]
    down = _operator(arrays, f"{number}.down", (coarse, size))
    return MeshLevel(size, faces, table, down, _operator(arrays, f"{number}.up", (size, coarse)))


def _operator(arrays: Mapping[str, npt.NDArray[Any]], name: str, shape: tuple[int, int]) -> Operator:
    rows, columns = (
        _within(arrays[f"{name}.{part}"], n, 1) for part, n in zip(("rows", "columns"), shape, strict=True)
    )
    weights = arrays[f"{name}.weights"].astype(np.float32)
    if not rows.shape == columns.shape == weights.shape:
        raise ValueError(name)
    return Operator(rows, columns, weights, shape)


def _within(index: npt.NDArray[Any], size: int, dimensions: int) -> Indices:
    if index.ndim != dimensions or (index.size and not (index.min() >= 0 and index.max() < size)):
        raise ValueError("an index out of range")
    return index.astype(np.int64)
