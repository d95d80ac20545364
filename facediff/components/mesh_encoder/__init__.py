"""Mesh encoders: the vertices of each frame to one feature."""

from facediff.components.mesh_encoder.base import MeshEncoder, MeshEncoderFactory, MeshTopology

__all__ = ["MeshEncoder", "MeshEncoderFactory", "MeshTopology"]
