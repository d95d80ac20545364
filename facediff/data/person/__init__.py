"""A speaker's video, reconstructed by another tool, as a corpus entry (``facediff data import-person``)."""

from facediff.data.person.importer import ImportReport, import_person

__all__ = ["ImportReport", "import_person"]
