"""Takes as weights of blendshapes."""

from facediff.blendshapes.arkit import ARKIT, arkit_name, live_link_name, mirror_pairs
from facediff.blendshapes.files import ShapeFiles, read_shape_files
from facediff.blendshapes.options import SolveOptions
from facediff.blendshapes.shapes import ShapeSet, fitted, read_shapes
from facediff.blendshapes.solve import solve
from facediff.blendshapes.tables import write_live_link, write_weights
from facediff.blendshapes.weights import Weights

__all__ = [
    "ARKIT",
    "ShapeFiles",
    "ShapeSet",
    "SolveOptions",
    "Weights",
    "arkit_name",
    "fitted",
    "live_link_name",
    "mirror_pairs",
    "read_shape_files",
    "read_shapes",
    "solve",
    "write_live_link",
    "write_weights",
]
