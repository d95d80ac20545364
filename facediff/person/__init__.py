"""A target person: from what reconstruction tools write to a corpus entry (``facediff data import-person``)."""

from facediff.person.importer import import_person
from facediff.person.report import Report

__all__ = ["Report", "import_person"]
