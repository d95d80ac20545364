"""A speaker as a corpus entry: from a reconstructed video, or from a take of Live Link Face and its sound."""

from facediff.data.person.importer import ImportReport, import_person
from facediff.data.person.take import TakeReport, import_take

__all__ = ["ImportReport", "TakeReport", "import_person", "import_take"]
