"""A take: one finished performance of a face, as every exporter, viewer and transfer gets it."""

from facediff.takes.archive import read_archive, write_archive
from facediff.takes.reading import read_take
from facediff.takes.take import Take
from facediff.takes.units import metres_per_unit

__all__ = ["Take", "metres_per_unit", "read_archive", "read_take", "write_archive"]
