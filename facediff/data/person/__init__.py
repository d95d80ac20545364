"""A target person: from what reconstruction tools write to a corpus entry (``facediff data import-person``)."""

from facediff.data.person.importer import Report, import_person

__all__ = ["Report", "import_person"]
