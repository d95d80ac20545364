"""Scoring files of predictions against files of truth, whoever wrote them."""

from facediff.evaluate.evaluator import evaluate
from facediff.evaluate.names import DEFAULT_PATTERNS, TRUTH_PATTERN
from facediff.evaluate.regions import read_region
from facediff.evaluate.report import Comparison, Interval, MethodResult, Missing, Report, Score, SequenceScores
from facediff.evaluate.table import text

__all__ = [
    "DEFAULT_PATTERNS",
    "TRUTH_PATTERN",
    "Comparison",
    "Interval",
    "MethodResult",
    "Missing",
    "Report",
    "Score",
    "SequenceScores",
    "evaluate",
    "read_region",
    "text",
]
