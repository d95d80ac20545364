"""Meshes for drawing: checked vertices, outward triangles, normals and hollows."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError
from facediff.utils.numerics import has_scipy

Faces = npt.NDArray[np.int32]
Float64 = npt.NDArray[np.float64]
Floats = npt.NDArray[np.floating[Any]]


def check_vertices(vertices: npt.ArrayLike, name: str, n_vertices: int | None = None) -> Float64:
    """Vertex positions (V, 3) as float64; refuses other shapes and numbers that are not finite."""
    array = np.asarray(vertices, np.float64)
    count = n_vertices or max(len(array), 1)
    if array.shape != (count, 3) or not np.isfinite(array).all():
        problem = "NaN or infinity" if array.shape == (count, 3) else f"the shape {array.shape}"
        raise FaceDiffError(
            f"{name}: {problem}; expected finite positions ({count}, 3), of the template's own topology"
        )
    return array


def face_outward(faces: Faces, template: Float64) -> Faces:
    """Triangles (F, 3) that are counter-clockwise seen from outside: all are reversed if the mesh is inside out."""
    # The sign of the flux that leaves through the faces decides. For a closed mesh it is the signed volume for any
    # reference point; for an open mask the point must lie behind the mesh (z looks at the viewer).
    low, high = template.min(axis=0), template.max(axis=0)
    behind = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2] - (high - low).max()])
    a, b, c = (template[faces[:, corner]] - behind for corner in range(3))
    flux = np.einsum("ij,ij->", a, np.cross(b, c))
    return faces if flux >= 0 else np.ascontiguousarray(faces[:, ::-1])


def is_open(faces: Faces) -> bool:
    """Whether an edge belongs to one triangle only, so that the inside may be visible."""
    starts, ends = faces.ravel().astype(np.int64), np.roll(faces, -1, axis=1).ravel()
    edges = np.minimum(starts, ends) * (int(faces.max()) + 1) + np.maximum(starts, ends)
    _, counts = np.unique(edges, return_counts=True)
    return bool((counts == 1).any())


class VertexSums:
    """Adds values of triangles (F, 3) at their vertices; made once per topology, for many frames."""

    def __init__(self, faces: Faces, n_vertices: int) -> None:
        corners = faces.ravel()
        self._corners, self._n_vertices = corners, n_vertices
        self.counts = np.maximum(np.bincount(corners, minlength=n_vertices), 1)[:, None]

    def __call__(self, values: Floats) -> Float64:
        """Sums (V, 3) of the triangles' values (F, 3)."""
        if not has_scipy():
            spread = np.repeat(np.asarray(values, np.float64), 3, axis=0)
            return np.stack([np.bincount(self._corners, component, self._n_vertices) for component in spread.T], axis=1)
        return np.asarray(self._at_vertices @ values, dtype=np.float64)

    def mean_centres(self, vertices: Floats) -> Float64:
        """The mean (V, 3) of the centres of each vertex's triangles."""
        return np.asarray((self._neighbours @ vertices) / (3 * self.counts), dtype=np.float64)

    @cached_property
    def _at_vertices(self) -> Any:  # noqa: ANN401 - a sparse matrix of scipy
        """Which triangles (F) each vertex (V) has."""
        from scipy.sparse import csr_array

        count = len(self._corners) // 3
        triangles = np.repeat(np.arange(count), 3)
        return csr_array((np.ones(len(triangles)), (self._corners, triangles)), shape=(self._n_vertices, count))

    @cached_property
    def _neighbours(self) -> Any:  # noqa: ANN401 - a sparse matrix of scipy
        """How many triangles each two vertices share."""
        return self._at_vertices @ self._at_vertices.T


def vertex_normals(vertices: Floats, faces: Faces, sums: VertexSums | None = None) -> Float64:
    """Unit normals (V, 3): the mean of the adjacent triangles' normals, weighted by their areas.

    A vertex without triangles (or with triangles of no area only) looks along +z. Give ``sums`` of the same faces where
    many frames of a topology need normals.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    (ux, uy, uz), (vx, vy, vz) = (b - a).T, (c - a).T
    # Written out, since numpy's cross product is several times slower on (F, 3). Its length is twice the triangle's
    # area, so that summing it unnormalised gives the weights.
    cross = np.stack([uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx], axis=1)
    normals = (sums or VertexSums(faces, len(vertices)))(cross)
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    flat = length <= np.finfo(np.float64).tiny
    normals[flat] = (0.0, 0.0, 1.0)
    length[flat] = 1.0
    return np.asarray(normals / length[:, None], dtype=np.float64)


def hollowness(vertices: Floats, normals: Float64, sums: VertexSums) -> Float64:
    """How far each vertex is below its neighbourhood, as a share of the neighbourhood's radius (V,).

    Positive in hollows (between the lips, in the corner of an eye), negative on ridges, near zero on smooth parts.
    """
    offset = sums.mean_centres(vertices) - vertices
    radius = np.sqrt(np.einsum("ij,ij->i", offset, offset)) + np.ptp(vertices, axis=0).max() * 1e-2
    return np.asarray(np.einsum("ij,ij->i", offset, normals) / radius, dtype=np.float64)
