"""What a mesh tells the renderer: sound faces, which side is outside, smooth normals, hollows."""

from typing import Any

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

Floats = npt.NDArray[np.floating[Any]]


def check_vertices(vertices: npt.ArrayLike, name: str, n_vertices: int | None = None) -> npt.NDArray[np.float64]:
    """One set of vertex positions as float64, refused with one sentence when it cannot be drawn.

    Args:
        vertices: positions (V, 3) in any length unit.
        name: what the array is called in the message.
        n_vertices: V where it is known already.
    """
    array = np.asarray(vertices)
    if array.ndim != 2 or array.shape[1] != 3 or array.shape[0] == 0:
        raise FaceDiffError(f"{name} must have the shape (vertices, 3), got {array.shape}: x, y, z each.")
    if n_vertices is not None and array.shape[0] != n_vertices:
        raise FaceDiffError(
            f"{name} has {array.shape[0]} vertices but the renderer's template has {n_vertices}: "
            "draw a motion with the template and the faces of its own topology."
        )
    if not np.issubdtype(array.dtype, np.number) or np.iscomplexobj(array):
        raise FaceDiffError(f"{name} must hold real numbers, got {array.dtype}: convert it to float32.")
    array = array.astype(np.float64)
    if not np.isfinite(array).all():
        bad = int(np.flatnonzero(~np.isfinite(array).all(axis=1))[0])
        raise FaceDiffError(f"{name} holds NaN or infinity (first at vertex {bad}): check its source.")
    return array


def check_faces(faces: npt.ArrayLike, n_vertices: int) -> npt.NDArray[np.int32]:
    """Triangles (F, 3) as int32, refused when one names a vertex that the template does not have."""
    array = np.asarray(faces)
    shaped = array.ndim == 2 and array.shape[1] == 3 and len(array) > 0
    if not shaped or not np.issubdtype(array.dtype, np.integer):
        raise FaceDiffError(
            f"faces must be whole numbers of the shape (faces, 3), got {array.dtype} {array.shape}: "
            "pass the triangles of the template's mesh file."
        )
    low, high = int(array.min()), int(array.max())
    if low < 0 or high >= n_vertices:
        raise FaceDiffError(
            f"faces name vertex {low if low < 0 else high} but the template has vertices 0 to "
            f"{n_vertices - 1}: pass the faces of the same topology (counting from 0)."
        )
    return array.astype(np.int32)


def face_outward(faces: npt.NDArray[np.int32], template: npt.NDArray[np.float64]) -> npt.NDArray[np.int32]:
    """Turn all faces round if the mesh is wound inside out.

    The sign of the flux that leaves through the faces decides. For a closed mesh it is the signed volume
    whatever the reference point; for an open mask the point lies behind the mesh (z looks at the viewer).
    """
    low, high = template.min(axis=0), template.max(axis=0)
    behind = np.array([(low[0] + high[0]) / 2, (low[1] + high[1]) / 2, low[2] - (high - low).max()])
    a, b, c = (template[faces[:, corner]] - behind for corner in range(3))
    flux = np.einsum("ij,ij->", a, np.cross(b, c))
    return faces if flux >= 0 else np.ascontiguousarray(faces[:, ::-1])


def is_open(faces: npt.NDArray[np.int32]) -> bool:
    """Whether an edge belongs to one face only, so that somebody may look inside."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    return bool((counts == 1).any())


def vertex_normals(vertices: Floats, faces: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
    """Unit normals (V, 3), each the mean of the adjacent faces' normals weighted by their areas.

    A vertex without a face (or with faces of no area only) looks along +z.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    # The cross product's length is twice the area: summing it unnormalised is the weighting.
    normals = sum_at_vertices(_cross(b - a, c - a), faces, len(vertices))
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))
    flat = length <= np.finfo(np.float64).tiny
    normals[flat] = (0.0, 0.0, 1.0)
    length[flat] = 1.0
    return np.asarray(normals / length[:, None], dtype=np.float64)


def hollowness(
    vertices: Floats, normals: npt.NDArray[np.float64], faces: npt.NDArray[np.int32]
) -> npt.NDArray[np.float64]:
    """How far each vertex lies below its neighbourhood, as a share of the neighbourhood's radius (V,).

    Positive in hollows (between the lips, in the corner of an eye), negative on ridges, near zero on
    smooth parts: the mean of the adjacent faces' centres, seen along the normal.
    """
    centres = (vertices[faces[:, 0]] + vertices[faces[:, 1]] + vertices[faces[:, 2]]) / 3
    counts = np.maximum(np.bincount(faces.ravel(), minlength=len(vertices)), 1)
    offset = sum_at_vertices(centres, faces, len(vertices)) / counts[:, None] - vertices
    radius = np.sqrt(np.einsum("ij,ij->i", offset, offset)) + np.ptp(vertices, axis=0).max() * 1e-2
    return np.asarray(np.einsum("ij,ij->i", offset, normals) / radius, dtype=np.float64)


def sum_at_vertices(values: Floats, faces: npt.NDArray[np.int32], n_vertices: int) -> npt.NDArray[np.float64]:
    """Add each face's values (F, 3) to its three vertices: (V, 3)."""
    corners = faces.ravel()
    return np.stack([np.bincount(corners, np.repeat(values[:, k], 3), minlength=n_vertices) for k in range(3)], axis=1)


def _cross(a: Floats, b: Floats) -> Floats:
    """Cross products of rows; numpy's own is several times slower on (F, 3)."""
    return np.stack(
        [
            a[:, 1] * b[:, 2] - a[:, 2] * b[:, 1],
            a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2],
            a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0],
        ],
        axis=1,
    )
