"""Animations as files of other programs: moving meshes, point caches, videos, tables of blendshape weights.

Example:
    >>> from facediff.export import FORMATS
    >>> FORMATS[".glb"].help
    'glTF 2.0 with morph targets, exact or named by weights or --shapes: Blender, Unity, three.js, Unreal'
"""

from facediff.animation.options import ExportOptions
from facediff.export.format import Format
from facediff.export.writing import FORMATS, check_export, check_used, is_film, write_animations

__all__ = ["FORMATS", "ExportOptions", "Format", "check_export", "check_used", "is_film", "write_animations"]
