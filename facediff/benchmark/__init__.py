"""Tables that anyone can regenerate: plans of methods, corpora and seeds, their cells and results."""

from facediff.benchmark.cells import Cell, cells_of, rows_of
from facediff.benchmark.outline import ReportOutline
from facediff.benchmark.plan import BenchmarkPlan, find_plan, read_plan
from facediff.benchmark.results import Result, read_result
from facediff.benchmark.tables import BenchmarkReport, report_of

__all__ = [
    "BenchmarkReport",
    "Cell",
    "ReportOutline",
    "BenchmarkPlan",
    "Result",
    "cells_of",
    "find_plan",
    "read_plan",
    "read_result",
    "report_of",
    "rows_of",
]
