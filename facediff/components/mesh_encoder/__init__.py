"""Mesh encoders: the motion of a mesh to one feature per frame."""

from facediff.components.mesh_encoder.base import MeshEncoder, MeshEncoderFactory

__all__ = ["MeshEncoder", "MeshEncoderFactory"]
