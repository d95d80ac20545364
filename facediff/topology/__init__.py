"""What depends on the mesh alone: faces of a template, coarser ones, and laying faces onto one another."""

from facediff.topology.alignment import Similarity, align, face_size, robust_align
from facediff.topology.hierarchy import MeshHierarchy, MeshLevel, mesh_hierarchy
from facediff.topology.mesh import Mesh, read_mesh
from facediff.topology.rigid_motion import RigidMotion, median_face, remove_rigid_motion, stable_vertices

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
