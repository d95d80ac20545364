"""Telling what a corpus folder is, and whether it is sound: ``facediff data check``."""

from facediff.doctor.check import check
from facediff.doctor.findings import Finding
from facediff.doctor.report import Report
from facediff.doctor.table import text

__all__ = ["Finding", "Report", "check", "text"]
