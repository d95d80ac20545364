"""A speaker's video, reconstructed by another tool, as a corpus entry (``facediff data import-person``)."""

from facediff.data.person.importer import Report, import_person

__all__ = ["Report", "import_person"]
