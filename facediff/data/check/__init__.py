"""Recognising and checking corpus folders: ``facediff data check``."""

from facediff.data.check.check import check
from facediff.data.check.findings import CheckReport, Finding, text

__all__ = ["Finding", "CheckReport", "check", "text"]
