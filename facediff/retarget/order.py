"""Whether a mesh is the one it is taken for, with its vertices in the same order."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from facediff.errors import FaceDiffError

ROUNDED = 1e-4
"""Files round coordinates; two places nearer than this share of the mesh's extent are one."""


def refuse_other_mesh(
    name: str,
    vertices: npt.NDArray[np.floating],
    faces: npt.NDArray[np.integer],
    expected_vertices: npt.NDArray[np.floating],
    expected_faces: npt.NDArray[np.integer],
) -> None:
    """Compare a mesh with the one that a correspondence was made for.

    Triangles must be equal; vertices may have moved, as another person's have.

    Args:
        name: what to call the mesh in the message.
        vertices: (V, 3).
        faces: (F, 3).
        expected_vertices: what they were.
        expected_faces: what they were.

    Raises:
        FaceDiffError: if it is another mesh, or the same one with its vertices or triangles in another order.
    """
    if len(vertices) != len(expected_vertices):
        raise FaceDiffError(
            f"{name}: has {len(vertices)} vertices, and the correspondence was made for a mesh of "
            f"{len(expected_vertices)}; give that mesh, or make a new correspondence"
        )
    if np.array_equal(faces, expected_faces):
        return
    extent = float(np.ptp(expected_vertices, axis=0).max())
    first, second = (_sorted(points, extent) for points in (vertices, expected_vertices))
    if np.abs(first - second).max() <= 2 * ROUNDED * extent:
        moved = int(np.count_nonzero(np.abs(vertices - expected_vertices).max(axis=1) > 2 * ROUNDED * extent))
        if moved:
            raise FaceDiffError(
                f"{name}: {moved} of its {len(vertices)} vertices are where others were: they were reordered, as "
                f"exporters do; write the mesh with the order of its vertices kept, or make a new correspondence"
            )
        raise FaceDiffError(
            f"{name}: has its vertices where they were and other triangles; give the mesh that the correspondence was "
            f"made for, or make a new one"
        )
    raise FaceDiffError(
        f"{name}: has as many vertices as the correspondence's mesh and other triangles; give the mesh that it was "
        f"made for, or make a new correspondence"
    )


def _sorted(points: npt.NDArray[np.floating], extent: float) -> npt.NDArray[np.float64]:
    """Rows in an order that does not depend on that of the vertices, rounding aside."""
    rows = np.asarray(points, np.float64)
    grid = np.rint(rows / (ROUNDED * extent))
    return rows[np.lexsort(grid.T)]
