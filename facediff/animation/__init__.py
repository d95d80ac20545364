"""A take: one finished performance of a face, as every exporter, viewer and transfer gets it."""

from facediff.animation.animation import Animation, metres_per_unit
from facediff.animation.files import read_animation, read_archive, write_archive

__all__ = ["Animation", "metres_per_unit", "read_archive", "read_animation", "write_archive"]
