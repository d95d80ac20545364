"""``plan.json`` in a benchmark's folder: the plan's labels and columns for reports, and its cells."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

from facediff.benchmark.cells import Cell, rows_of
from facediff.benchmark.plan import BenchmarkPlan
from facediff.benchmark.results import CELLS, Result, read_result
from facediff.utils.limits import check_format
from facediff.utils.plain_files import load_json, write_json
from facediff.utils.records import Text, read_record

FILE = "plan.json"
FORMAT = 1
FileName = Annotated[str, Text(r"(?!\.{0,2}$)[^/\\]+", "a file's name")]


@dataclass(frozen=True)
class ReportOutline:
    """The part of a plan that reports need, as plain data in the benchmark's folder."""

    name: FileName
    title: str
    description: str
    protocol: str  # by which all was scored
    # Scores and :data:`~facediff.benchmark.plan.COSTS` that are shown; all scores if none is named, and all costs
    columns: tuple[str, ...]
    baseline: str  # the row that others are compared with; the first if empty
    references: tuple[str, ...]  # rows that were not trained
    rows: Mapping[str, tuple[str, str]]  # label, and name in papers' tables, by row
    corpora: Mapping[str, str]  # label by corpus
    published: tuple[str, ...]  # names of papers' tables
    cells: tuple[FileName, ...]  # files of results by row and corpus, in the order of the plan
    command: str = ""


def outline_of(plan: BenchmarkPlan, cells: Sequence[Cell], command: str) -> ReportOutline:
    """The part of a plan that reports need."""
    return ReportOutline(
        name=plan.name,
        title=plan.title,
        description=plan.description,
        protocol=plan.protocol,
        columns=plan.columns,
        baseline=plan.baseline,
        references=plan.references,
        rows={row.name: (row.label, row.published) for row in rows_of(plan)},
        corpora={name: corpus.label for name, corpus in plan.corpora.items()},
        published=plan.published,
        cells=tuple(cell.file_name for cell in cells),
        command=command,
    )


def write_outline(folder: Path, outline: ReportOutline) -> None:
    """Write it into a benchmark's folder, whole or not at all."""
    write_json(folder / FILE, {"format": FORMAT, **asdict(outline)})


def read_outline(folder: Path) -> ReportOutline:
    """The outline of a benchmark's folder."""
    path, remedy = folder / FILE, "expected a folder that `facediff benchmark` wrote, such as benchmarks/quick"
    content = load_json(path, remedy=remedy)
    check_format(path, content.get("format") if isinstance(content, dict) else None, FORMAT)
    return read_record(ReportOutline, content, path, remedy=remedy, strict=False)


def read_results(folder: Path, outline: ReportOutline) -> tuple[list[Result], list[str]]:
    """The results of a benchmark's cells, and the names of the cells without a result."""
    results, pending = [], []
    for name in outline.cells:
        result = read_result(folder / CELLS / f"{name}.json")
        if result is None:
            pending.append(name)
        elif result.row in outline.rows and result.corpus in outline.corpora:
            results.append(result)
    return results, pending
