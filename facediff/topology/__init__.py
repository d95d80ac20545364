"""What depends on the mesh alone: faces of a template."""

from facediff.topology.mesh import Mesh, read_mesh

__all__ = ["Mesh", "read_mesh"]
