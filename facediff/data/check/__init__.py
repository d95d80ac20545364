"""Telling what a corpus folder is, and whether it is sound: ``facediff data check``."""

from facediff.data.check.check import check
from facediff.data.check.findings import Finding, Report
from facediff.data.check.table import text

__all__ = ["Finding", "Report", "check", "text"]
