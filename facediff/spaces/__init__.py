"""The spaces that motion is written in: vertices of a mesh, or parameters such as ARKit's and FLAME's."""

from facediff.spaces.layouts import layout
from facediff.spaces.space import VERTICES, Rotation, Space

__all__ = ["VERTICES", "Rotation", "Space", "layout"]
