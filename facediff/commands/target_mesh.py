"""``--target-mesh``: a take on another mesh, for every command that has one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from facediff.errors import FaceDiffError

if TYPE_CHECKING:
    from facediff.retarget import Correspondence
    from facediff.takes import Take


def carried(take: Take, mesh_path: Path, correspondence_path: Path | None = None) -> Take:
    """A take on the mesh in a file.

    Args:
        take: the performance, with triangles.
        mesh_path: the other face at rest.
        correspondence_path: used if it is there, else written; None for neither.

    Raises:
        FaceDiffError: if a file is unreadable, or a mesh is not the correspondence's or has its vertices in another
            order.
    """
    return carried_with(take, mesh_path, correspondence_path)[0]


def carried_with(
    take: Take, mesh_path: Path, correspondence_path: Path | None = None, landmarks_path: Path | None = None
) -> tuple[Take, Correspondence]:
    """A take on the mesh in a file, and the correspondence; arguments and errors as :func:`carried`.

    Args:
        take: the performance.
        mesh_path: the other face at rest.
        correspondence_path: used if it is there, else written.
        landmarks_path: CSV of vertex pairs, for a correspondence that is not there yet.
    """
    from facediff.files import check_writable
    from facediff.retarget import (
        carry,
        correspond,
        load_correspondence,
        read_landmarks,
        refuse_other_mesh,
        save_correspondence,
    )
    from facediff.topology import read_mesh

    triangles = take.triangles  # what it lacks is not the other mesh's fault
    mesh = read_mesh(mesh_path)
    if correspondence_path is not None and correspondence_path.exists():
        if landmarks_path is not None:
            raise FaceDiffError(
                f"--landmarks {landmarks_path}: {correspondence_path} is there already and would be used without them; "
                f"remove it, or leave the landmarks away"
            )
        found = load_correspondence(correspondence_path)
        refuse_other_mesh(str(mesh_path), mesh.vertices, mesh.faces, found.target_vertices, found.target_faces)
        return carry(take, found, mesh), found
    if correspondence_path is not None:
        if correspondence_path.suffix != ".npz":
            raise FaceDiffError(f"--correspondence {correspondence_path}: expected a name that ends in .npz")
        check_writable(correspondence_path)
    landmarks = None if landmarks_path is None else read_landmarks(landmarks_path)
    try:
        found = correspond(take.template, triangles, mesh.vertices, mesh.faces, landmarks=landmarks)
    except FaceDiffError as error:
        raise FaceDiffError(f"{mesh_path}: {error}") from error
    made = carry(take, found, mesh)
    if correspondence_path is not None:
        save_correspondence(correspondence_path, found)
    return made, found
