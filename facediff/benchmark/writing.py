"""A benchmark's report as Markdown, LaTeX, CSV and HTML, and as text for the terminal."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from facediff.benchmark.significance import Difference, RowScores
from facediff.benchmark.tables import BenchmarkReport, Table, TableRow
from facediff.errors import FaceDiffError
from facediff.reporting.documents import (
    NONE,
    Block,
    Bullets,
    Paragraph,
    ReportTable,
    Title,
    between,
    html_page,
    latex,
    markdown,
    p_value,
    terminal_text,
    write_texts,
)
from facediff.reporting.statistics import Interval
from facediff.utils.files import atomic
from facediff.utils.plain_files import write_rows

TITLES = {
    **{"mve": "MVE", "lve": "LVE", "fdd": "FDD", "fdd_absolute": "FDD, absolute", "fdd_signed": "FDD, signed"},
    "rtf": "RTF",
}
MOST_DIGITS = 4
"""Decimals of papers' tables, and of numbers without an interval."""
BEGIN, END = (
    "<!-- benchmark {name}: begin, written by `facediff benchmark report` -->",
    "<!-- benchmark {name}: end -->",
)


def write_report(report: BenchmarkReport, folder: Path) -> list[Path]:
    """Write all forms into a folder; the files."""
    if not report.tables:
        reason = f"; the first problem: {report.failed[0]}" if report.failed else ""
        raise FaceDiffError(f"{report.outline.name}: no cell has a result yet{reason}; run `facediff benchmark` first")
    name, blocks = report.outline.name, document(report)
    texts = {
        f"{name}.md": markdown(blocks),
        f"{name}.tex": latex_tables(report),
        f"{name}.html": html_page(report.outline.title, blocks),
    }
    files = write_texts(folder, texts)
    write_rows(folder / f"{name}.csv", csv_rows(report))
    return [*files, folder / f"{name}.csv"]


# Numbers.


@dataclass(frozen=True)
class Scale:
    """The power of ten that a column is given in, and its decimals: those that the narrowest interval leaves known."""

    exponent: int
    digits: int = MOST_DIGITS

    @classmethod
    def of(
        cls,
        values: Sequence[float],
        intervals: Iterable[Interval | None] = (),
        deviations: Iterable[float | None] = (),
    ) -> Scale:
        """The power of ten of the smallest number; none for numbers that read well as they are.

        Half the narrowest interval is shown with two significant digits and the smallest deviation with one, and all
        numbers with as many decimals.
        """
        magnitudes = [abs(value) for value in values if value]
        plain = not magnitudes or (min(magnitudes) >= 0.01 and max(magnitudes) < 1000)
        exponent = 0 if plain else _magnitude(min(magnitudes))
        widths = [(interval.high - interval.low) / 2 for interval in intervals if interval is not None]
        decimals = [1 - _magnitude(width) for width in widths if width > 0 and math.isfinite(width)]
        decimals += [-_magnitude(deviation) for deviation in deviations if deviation]
        return cls(exponent, min(max(exponent + max(decimals), 0), MOST_DIGITS) if decimals else MOST_DIGITS)

    def number(self, value: float | None, digits: int | None = None, sign: str = "") -> str:
        """A number without its power of ten, with the column's decimals if none are given."""
        decimals = self.digits if digits is None else digits
        return NONE if value is None else f"{value / 10.0**self.exponent:{sign}.{decimals}f}"

    def interval(self, interval: Interval | None, sign: str = "") -> str:
        """An interval in brackets."""
        if interval is None:
            return NONE
        return between(interval.low, interval.high, lambda end: self.number(end, sign=sign))


def _magnitude(value: float) -> int:
    return math.floor(math.log10(abs(value)))


def scales(table: Table) -> dict[str, Scale]:
    """The scale of each column."""
    return {
        column: Scale.of(
            [row.scores[column].mean for row in table.rows if column in row.scores],
            [row.intervals.get(column) for row in table.rows],
            [row.scores[column].deviation for row in table.rows if column in row.scores],
        )
        for column in table.columns
    }


def title_of(column: str) -> str:
    """A score's name as tables print it."""
    return TITLES.get(column, column)


def head_of(column: str, scale: Scale) -> str:
    """A score's name with its power of ten and the better direction."""
    power = f" /1e{scale.exponent}" if scale.exponent else ""
    return f"{title_of(column)}{power}"


def arrow(better: str | None) -> str:
    """Which way is better."""
    return {"lower": " ↓", "higher": " ↑", "zero": " →0"}.get(str(better), "")


def cost_cells(row: TableRow, costs: Sequence[str]) -> list[str]:
    """The table's cells of weights, speed, training time and memory."""
    cost = row.cost
    cells = {
        "weights": NONE if cost.parameters is None else f"{cost.parameters / 1e6:.2f} M",
        "rtf": NONE if cost.factor is None else f"{cost.factor:.3g}",
        "training": NONE if cost.training is None else f"{cost.training:.0f} s",
        "memory": NONE if cost.memory is None else f"{cost.memory / 2**30:.2f} GiB",
    }
    return [cells[name] for name in costs]


def mean_and_deviation(row: TableRow, column: str, scale: Scale) -> str:
    """Mean ± standard deviation over training runs."""
    scores = row.scores.get(column)
    if scores is None:
        return NONE
    deviation = "" if scores.deviation is None else f" ± {scale.number(scores.deviation)}"
    return f"{scale.number(scores.mean)}{deviation}"


# The blocks of a report.


def document(report: BenchmarkReport) -> list[Block]:
    """The whole report."""
    outline = report.outline
    return [
        Title(outline.title),
        *([Paragraph(outline.description)] if outline.description else []),
        *body(report),
    ]


def body(report: BenchmarkReport) -> list[Block]:
    """The report without its title."""
    blocks: list[Block] = []
    if any(table.synthetic for table in report.tables):
        blocks.append(Paragraph("Synthetic data: these results are not about real people.", warning=True))
    for table in report.tables:
        facts = f"{table.frames} frames, {table.sequences} sentences"
        regions = [
            f"{part} {facts_of_part['count']} vertices (hash {facts_of_part['hash']})"
            for part, facts_of_part in table.regions.items()
            if isinstance(facts_of_part, dict) and "count" in facts_of_part
        ]
        notes = [f"{facts}; {', '.join(regions)}" if regions else facts, *table.notes]
        notes += [f"printed figures: {source}" for source in table.published.sources] + list(table.published.reasons)
        blocks += [Title(table.title, 2), main_table(table, printed=True), *details(table, report), Bullets(notes)]
    definitions = [line.strip() for line in report.definition.splitlines() if line.strip()]
    return [*blocks, Title("Definitions", 2), Bullets(about(report)), Bullets(definitions)]


def main_table(table: Table, *, printed: bool = False, level: float | None = None, caption: str = "") -> ReportTable:
    """Scores and costs of every row.

    Papers' figures stand next to them if ``printed``; a star marks significant differences from the baseline at
    ``level``, unless it is None.
    """
    scale = scales(table)
    figures = table.published.scores
    paper = [column for column in table.columns if any(column in row for row in figures.values())] if printed else []
    rows: list[list[str]] = []
    marks: dict[tuple[int, int], str] = {}
    for index, row in enumerate(table.rows):
        cells = [mean_and_deviation(row, column, scale[column]) for column in table.columns]
        if level is not None:
            starred = [row.significant(column, level) for column in table.columns]
            cells = [cell + "*" * star for cell, star in zip(cells, starred, strict=True)]
        cells += [scale[column].number(figures.get(row.name, {}).get(column), MOST_DIGITS) for column in paper]
        rows.append([row.label, *cells, NONE if not row.seeds else str(len(row.seeds)), *cost_cells(row, table.costs)])
        marks |= {(index, number): row.marks.get(column, "") for number, column in enumerate(table.columns, 1)}
    head = ["", *(head_of(column, scale[column]) + arrow(better) for column, better in table.columns.items())]
    head += [*(f"{title_of(column)}, printed" for column in paper), "runs", *map(title_of, table.costs)]
    references = frozenset(index for index, row in enumerate(table.rows) if row.reference)
    return ReportTable(head, rows, marks, references, caption)


def details(table: Table, report: BenchmarkReport) -> list[Block]:
    """Intervals, and comparisons with the baseline."""
    scale = scales(table)
    intervals = [
        [row.label, *(scale[column].interval(row.intervals.get(column)) for column in table.columns)]
        for row in table.rows
    ]
    blocks: list[Block] = [
        Paragraph(f"{100 * report.bootstrap.level:.0f} % intervals over sentences (bootstrap):"),
        ReportTable(["", *(head_of(column, scale[column]) for column in table.columns)], intervals),
    ]
    if comparisons := comparison_rows(table, report):
        blocks += [
            Paragraph(f"Against {table.row(table.baseline).label}:"),
            ReportTable(COMPARISON, comparisons),
        ]
    return blocks


COMPARISON = ("row", "score", "difference", "over sentences", "over runs", "over both", "p", "corrected p", "")


def comparison_rows(table: Table, report: BenchmarkReport) -> list[list[str]]:
    """Each row against the baseline, score by score; a star where chance does not explain the difference."""
    scale = scales(table)
    rows = []
    for row in table.rows:
        for column, (difference, adjusted) in row.differences.items():
            form = scale[column]
            star = "*" if row.significant(column, report.bootstrap.level) else ""
            cells = [row.label, title_of(column), form.number(difference.value, sign="+")]
            chances = (difference.sentences, difference.runs, difference.total)
            cells += [form.interval(interval, sign="+") for interval in chances]
            cells += [p_value(difference.p), p_value(adjusted), star]
            rows.append(cells)
    return rows


def about(report: BenchmarkReport) -> list[str]:
    """The meaning of the tables' signs, and the versions that computed them."""
    boot = report.bootstrap
    alpha = 1 - boot.level
    lines = [
        f"protocol {report.outline.protocol}; mean ± standard deviation (n − 1) over training runs with different "
        f"seeds: the chance between runs",
        f"intervals: {boot.resamples} bootstrap resamples of the sentences, seed {boot.seed}: the chance between "
        f"sentences, with the trained models as they are",
        "differences are paired by sentence; over runs: Welch's interval; over both: the variances of sentences and of "
        "training runs added up (Satterthwaite), of which p is; corrected after Holm for the rows of one score without "
        "the references",
        f"a star, bold (best) and underlined (second best): corrected p below {alpha:.2g}; best and second best only "
        f"where they differ so from every row behind them, corrected for those alone; references are never marked; "
        f"without marks, the data do not show which is best",
        "still face and mean face never move; shuffled speech is the model given another sentence's speech",
    ]
    factors = [row.cost.factor for table in report.tables for row in table.rows if row.cost.factor is not None]
    machines = {
        f"{result.machine.get('gpu') or result.machine.get('processor')}, {result.machine.get('threads')} thread(s)"
        for result in report.results
        if result.machine.get("processor") and not result.problem
    }
    if factors:
        lines.append(
            f"RTF: seconds of computing for a second of speech, in batches as in the test; memory: the most of "
            f"training and test; on {'; '.join(sorted(machines))}"
        )
    lines += report.remarks
    lines += [f"no result yet: {name}" for name in report.pending]
    lines += [f"failed: {problem}" for problem in report.failed]
    codes = sorted({" ".join(result.code.values()) for result in report.results if result.code})
    lines.append(
        f"facediff {', '.join(codes)}" + (f"; made by `{report.outline.command}`" if report.outline.command else "")
    )
    return lines


def latex_tables(report: BenchmarkReport) -> str:
    """Tables for a paper."""
    outline = report.outline
    return latex(
        main_table(
            table,
            caption=f"{outline.title}: {table.title}. {'Synthetic data. ' if table.synthetic else ''}"
            f"Protocol {outline.protocol}; mean ± standard deviation over "
            f"training runs; {table.sequences} sentences, {table.frames} frames.",
        )
        for table in report.tables
    )


def replace_block(path: Path, report: BenchmarkReport) -> None:
    """Put the tables into a Markdown page, between two comments that bear the plan's name."""
    name = report.outline.name
    begin, end = BEGIN.format(name=name), END.format(name=name)
    with path.open(encoding="utf-8", newline="") as stream:  # keeps its line ends
        text = stream.read()
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(end) < text.index(begin):
        raise FaceDiffError(f"{path}: has no block for {name}; add the two lines  {begin}  and  {end}  to the page")
    # Headings of the page are one level above the tables'.
    blocks = body(report)
    lowered = [replace(block, level=block.level + 1) if isinstance(block, Title) else block for block in blocks]
    block = f"{begin}\n\n{markdown(lowered)}\n".replace("\n", "\r\n" if "\r\n" in text else "\n")
    with atomic(path) as temporary:
        temporary.write_text(
            f"{text[: text.index(begin)]}{block}{text[text.index(end) :]}", encoding="utf-8", newline=""
        )


# CSV.

NOTHING = Difference(0.0, None, None, None, None, None, None, 0)
"""For the row that all others are compared with."""


def csv_rows(report: BenchmarkReport) -> list[dict[str, Any]]:
    """One flat row for each table, row and score."""
    return [
        _csv_row(report, table, row, column, scores)
        for table in report.tables
        for row in table.rows
        for column, scores in row.scores.items()
    ]


def _csv_row(report: BenchmarkReport, table: Table, row: TableRow, column: str, scores: RowScores) -> dict[str, Any]:
    def ends(name: str, interval: Interval | None) -> dict[str, float | None]:
        low, high = (None, None) if interval is None else (interval.low, interval.high)
        return {f"{name}_low": low, f"{name}_high": high}

    difference, adjusted = row.differences.get(column, (NOTHING, None))
    return {
        **{"corpus": table.corpus, "synthetic": table.synthetic, "split": table.split},
        **{"row": row.name, "label": row.label},
        **{"score": column, "protocol": report.outline.protocol, "mean": scores.mean},
        **{"deviation_over_runs": scores.deviation, "runs": len(row.seeds)},
        "seeds": " ".join(str(seed) for seed in row.seeds if seed is not None),
        **ends("sentences", row.intervals.get(column)),
        "mark": row.marks.get(column, ""),
        "difference": None if difference is NOTHING else difference.value,
        **ends("difference_sentences", difference.sentences),
        "p_sentences": difference.p_sentences,
        **ends("difference_runs", difference.runs),
        "p_runs": difference.p_runs,
        **ends("difference_both", difference.total),
        "p": difference.p,
        "p_corrected": adjusted,
        "printed": table.published.scores.get(row.name, {}).get(column),
        **{"frames": table.frames, "sentences": row.clips, "parameters": row.cost.parameters},
        **{"real_time_factor": row.cost.factor, "training_seconds": row.cost.training},
        "memory_bytes": row.cost.memory,
    }


def text(report: BenchmarkReport) -> str:
    """The main tables for the terminal."""
    blocks: list[Block] = []
    for table in report.tables:
        kind = "SYNTHETIC corpus " if table.synthetic else ""
        blocks.append(Title(f"{kind}{table.title}: {table.sequences} sentences, {table.frames} frames"))
        blocks.append(main_table(table, level=report.bootstrap.level))
        notes = [f"note: {note}" for note in (*table.notes, *table.published.reasons)]
        blocks += [Bullets(notes)] if notes else []
    return "\n" + terminal_text([*blocks, Bullets(about(report))])
