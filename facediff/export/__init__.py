"""Takes to the files of other programs: meshes that move, point caches, videos, tables of weights."""

from facediff.export.format import ExportOptions, Format
from facediff.export.writing import FORMATS, check_export, write_animations

__all__ = ["FORMATS", "ExportOptions", "Format", "check_export", "write_animations"]
