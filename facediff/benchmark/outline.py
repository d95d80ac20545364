"""``plan.json`` in a benchmark's folder: what a report needs of the plan, and which results are its cells'."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from facediff.benchmark.cells import Cell, rows_of
from facediff.benchmark.plan import BenchmarkPlan
from facediff.benchmark.results import CELLS, Result, read_result
from facediff.benchmark.tables import ReportOutline
from facediff.errors import FaceDiffError
from facediff.utils.limits import check_format, quoted
from facediff.utils.plain_files import load_json, write_json

FILE = "plan.json"
FORMAT = 1


def outline_of(plan: BenchmarkPlan, cells: Sequence[Cell], command: str) -> ReportOutline:
    """What a report needs of a plan."""
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
    path, remedy = folder / FILE, "expected a folder that `facediff benchmark` wrote; run it again"
    if not path.is_file():
        raise FaceDiffError(f"{folder}: holds no {FILE}; expected the folder of a benchmark, such as benchmarks/quick")
    content = load_json(path, remedy=remedy)
    if not isinstance(content, dict):
        raise FaceDiffError(f"{path}: holds no JSON object; {remedy}")
    check_format(path, content.get("format"), FORMAT)
    fields: dict[str, Any] = {}
    for key, field in ReportOutline.__dataclass_fields__.items():
        value = content.get(key)
        listed = str(field.type).startswith("tuple")
        fits = isinstance(value, list) if listed else isinstance(value, dict if "Mapping" in str(field.type) else str)
        if not fits or (listed and not all(isinstance(entry, str) for entry in value or ())):
            raise FaceDiffError(f"{path}: {key} is {quoted(value)}; {remedy}")
        fields[key] = tuple(value) if isinstance(value, list) else value
    rows = fields["rows"]
    for name, row in rows.items():
        if not isinstance(row, list) or len(row) != 2 or not all(isinstance(text, str) for text in row):
            raise FaceDiffError(f"{path}: rows: {name} is {quoted(row)}; {remedy}")
    if not all(isinstance(label, str) for label in fields["corpora"].values()):
        raise FaceDiffError(f"{path}: corpora is {quoted(fields['corpora'])}; {remedy}")
    if any("/" in name or "\\" in name or name in ("", ".", "..") for name in (*fields["cells"], fields["name"])):
        raise FaceDiffError(f"{path}: names a file elsewhere; {remedy}")
    return ReportOutline(**{**fields, "rows": {name: (row[0], row[1]) for name, row in rows.items()}})


def read_results(folder: Path, outline: ReportOutline) -> tuple[list[Result], list[str]]:
    """The results of a benchmark's cells, and the names of those that have none yet."""
    results, missing = [], []
    for name in outline.cells:
        result = read_result(folder / CELLS / f"{name}.json")
        if result is None:
            missing.append(name)
        elif result.row in outline.rows and result.corpus in outline.corpora:
            results.append(result)
    return results, missing
