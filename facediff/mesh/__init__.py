"""Meshes: reading and coarsening them, alignment of faces, and the FLAME head model."""

from facediff.mesh.alignment import (
    RigidMotion,
    Similarity,
    align,
    face_size,
    median_face,
    remove_rigid_motion,
    robust_align,
    stable_vertices,
)
from facediff.mesh.hierarchy import MeshHierarchy, MeshLevel, mesh_hierarchy
from facediff.mesh.mesh import Mesh
from facediff.mesh.mesh_files import read_mesh

__all__ = [
    "Mesh",
    "MeshHierarchy",
    "MeshLevel",
    "RigidMotion",
    "Similarity",
    "align",
    "face_size",
    "median_face",
    "mesh_hierarchy",
    "read_mesh",
    "remove_rigid_motion",
    "robust_align",
    "stable_vertices",
]
