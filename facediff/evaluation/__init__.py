"""Scoring files of predictions against files of truth, from any program."""

from facediff.evaluation.evaluator import evaluate
from facediff.evaluation.file_pairs import DEFAULT_PATTERNS, TRUTH_PATTERN, Missing, read_region
from facediff.evaluation.report import Comparison, EvaluationReport, MethodResult, Score, SequenceScores, text
from facediff.reporting.statistics import Interval

__all__ = [
    "DEFAULT_PATTERNS",
    "TRUTH_PATTERN",
    "Comparison",
    "Interval",
    "MethodResult",
    "Missing",
    "EvaluationReport",
    "Score",
    "SequenceScores",
    "evaluate",
    "read_region",
    "text",
]
