"""A benchmark's report as Markdown, LaTeX, CSV and HTML, and as text for the terminal."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facediff.benchmark.plots import Panel, curves_plot, scatter_plot, speed_plot
from facediff.benchmark.statistics import Difference
from facediff.benchmark.tables import BenchmarkReport, Table, TableRow
from facediff.errors import FaceDiffError, printable
from facediff.evaluation.report import Interval
from facediff.utils.files import atomic
from facediff.utils.plain_files import write_rows
from facediff.utils.tables import format_table, html_table, html_text
from facediff.utils.tables import latex_text as tex

NONE = "–"
TITLES = {"mve": "MVE", "lve": "LVE", "fdd": "FDD", "fdd_absolute": "FDD, absolute", "fdd_signed": "FDD, signed"}
BEGIN, END = (
    "<!-- benchmark {name}: begin, written by `facediff benchmark report` -->",
    "<!-- benchmark {name}: end -->",
)


def write_report(report: BenchmarkReport, folder: Path) -> list[Path]:
    """Write all forms into a folder; the files.

    Raises:
        FaceDiffError: if there is nothing to write, or the folder cannot be written.
    """
    if not report.tables:
        reason = f"; the first problem: {report.failed[0]}" if report.failed else ""
        raise FaceDiffError(f"{report.outline.name}: no cell has a result yet{reason}; run `facediff benchmark` first")
    name = report.outline.name
    files: list[Path] = []
    for suffix, content in ((".md", markdown(report)), (".tex", latex(report)), (".html", page(report))):
        path = folder / f"{name}{suffix}"
        with atomic(path) as temporary:
            temporary.write_text(content, encoding="utf-8", errors="backslashreplace")
        files.append(path)
    write_rows(folder / f"{name}.csv", csv_rows(report))
    files.append(folder / f"{name}.csv")
    for place, panel in panels(report).items():
        path = folder / f"{name}_{place}.svg"
        with atomic(path) as temporary:
            temporary.write_text(panel.svg, encoding="utf-8", errors="backslashreplace")
        files.append(path)
    return files


# Numbers.


@dataclass(frozen=True)
class Scale:
    """The power of ten that a column is given in, so that its numbers have no zeros in front."""

    exponent: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Scale:
        """That of the smallest number; none for numbers that read well as they are."""
        magnitudes = [abs(value) for value in values if value]
        if not magnitudes or (min(magnitudes) >= 0.01 and max(magnitudes) < 1000):
            return cls(0)
        return cls(math.floor(math.log10(min(magnitudes))))

    def number(self, value: float | None, digits: int = 4, sign: str = "") -> str:
        """A number without its power of ten."""
        return NONE if value is None else f"{value / 10.0**self.exponent:{sign}.{digits}f}"

    def interval(self, interval: Interval | None, digits: int = 3, sign: str = "") -> str:
        """An interval in brackets."""
        if interval is None:
            return NONE
        return f"[{self.number(interval.low, digits, sign)}, {self.number(interval.high, digits, sign)}]"


def scales(table: Table) -> dict[str, Scale]:
    """The scale of each column."""
    return {
        column: Scale.of([row.scores[column].mean for row in table.rows if column in row.scores])
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


def cost_cells(row: TableRow) -> list[str]:
    """Weights, speed, training time and memory."""
    cost = row.cost
    return [
        NONE if cost.parameters is None else f"{cost.parameters / 1e6:.2f} M",
        NONE if cost.factor is None else f"{cost.factor:.3g}",
        NONE if cost.training is None else f"{cost.training:.0f} s",
        NONE if cost.memory is None else f"{cost.memory / 2**30:.2f} GiB",
    ]


COSTS = ("weights", "RTF", "training", "memory")


def mean_and_deviation(row: TableRow, column: str, scale: Scale) -> str:
    """Mean ± standard deviation over training runs."""
    scores = row.scores.get(column)
    if scores is None:
        return NONE
    deviation = "" if scores.deviation is None else f" ± {scale.number(scores.deviation)}"
    return f"{scale.number(scores.mean)}{deviation}"


def runs_of(row: TableRow) -> str:
    """How many training runs."""
    return NONE if not row.seeds else str(len(row.seeds))


def p_value(value: float | None) -> str:
    """A p-value."""
    return NONE if value is None else "<0.001" if value < 0.001 else f"{value:.3f}"


# Markdown.


def markdown(report: BenchmarkReport) -> str:
    """The whole report."""
    outline = report.outline
    lines = [f"# {cell(outline.title)}", "", *([cell(outline.description), ""] if outline.description else [])]
    return "\n".join([*lines, *markdown_body(report), ""])


def markdown_body(report: BenchmarkReport) -> list[str]:
    """The report without its title."""
    lines: list[str] = []
    if any(table.synthetic for table in report.tables):
        lines += ["**Synthetic data**: what follows says nothing about real people.", ""]
    for table in report.tables:
        lines += [f"## {cell(table.title)}", "", *markdown_table(table, report), ""]
    lines += ["## What the numbers are", "", *[f"- {cell(line)}" for line in about(report)], ""]
    definitions = [line.strip() for line in report.definition.splitlines() if line.strip()]
    lines += [f"- {cell(line)}" for line in definitions]
    return lines


def cell(text: object) -> str:
    """Text that Markdown shows as it is; what stands between backticks is code, in which only bars are special."""
    parts = printable(text).split("`")
    if len(parts) % 2 == 0:
        parts = ["`".join(parts)]
    for place in range(0, len(parts), 2):
        parts[place] = re.sub(r"([|<>*_`\[\]])", r"\\\1", parts[place])
    for place in range(1, len(parts), 2):
        parts[place] = parts[place].replace("|", "\\|")
    return "`".join(parts)


def markdown_grid(head: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """A table of finished cells."""
    lines = [f"| {' | '.join(head)} |", f"|{'|'.join(['---'] + ['---:'] * (len(head) - 1))}|"]
    return [*lines, *(f"| {' | '.join(row)} |" for row in rows)]


def markdown_table(table: Table, report: BenchmarkReport) -> list[str]:
    """Scores, intervals, and comparisons of one table."""
    scale = scales(table)
    emphasis = {"best": "**{}**", "second": "<u>{}</u>", "": "{}"}
    paper = [column for column in table.columns if any(column in each for each in table.published.scores.values())]
    head = ["", *(head_of(column, scale[column]) + arrow(better) for column, better in table.columns.items())]
    head += [f"{title_of(column)}, printed" for column in paper] + ["runs", *COSTS]
    rows = []
    for row in table.rows:
        cells = [
            emphasis[row.marks.get(column, "")].format(mean_and_deviation(row, column, scale[column]))
            for column in table.columns
        ]
        cells += [scale[column].number(table.published.scores.get(row.name, {}).get(column)) for column in paper]
        name = f"*{cell(row.label)}*" if row.reference else cell(row.label)
        rows.append([name, *cells, runs_of(row), *cost_cells(row)])
    lines = markdown_grid(head, rows)
    lines += ["", f"{100 * report.bootstrap.level:.0f} % intervals over sentences (bootstrap):", ""]
    intervals = [
        [cell(row.label), *(scale[column].interval(row.intervals.get(column)) for column in table.columns)]
        for row in table.rows
    ]
    lines += markdown_grid(["", *(head_of(column, scale[column]) for column in table.columns)], intervals)
    comparisons = comparison_rows(table, report)
    if comparisons:
        lines += ["", f"Against {cell(table.row(table.baseline).label)}:", ""]
        lines += markdown_grid(COMPARISON, [[cell(text) for text in row] for row in comparisons])
    facts = f"{table.frames} frames, {table.sequences} sentences"
    regions = [
        f"{part} {each['count']} vertices (hash {each['hash']})"
        for part, each in table.regions.items()
        if isinstance(each, dict) and "count" in each
    ]
    notes = [f"{facts}; {', '.join(regions)}" if regions else facts, *table.notes]
    notes += [f"printed figures: {source}" for source in table.published.sources] + list(table.published.reasons)
    return [*lines, "", *(f"- {cell(note)}" for note in notes)]


COMPARISON = ("row", "score", "difference", "over sentences", "p", "over runs", "p", "corrected p", "")


def comparison_rows(table: Table, report: BenchmarkReport) -> list[list[str]]:
    """Each row against the baseline, score by score; a star where neither chance explains the difference."""
    scale = scales(table)
    rows = []
    for row in table.rows:
        for column, (found, adjusted) in row.differences.items():
            own = scale[column]
            star = "*" if row.significant(column, report.bootstrap.level) else ""
            rows.append(
                [
                    *(row.label, title_of(column), own.number(found.value, sign="+")),
                    *(own.interval(found.sentences, sign="+"), p_value(found.p_sentences)),
                    *(own.interval(found.runs, sign="+"), p_value(found.p_runs)),
                    *(p_value(adjusted), star),
                ]
            )
    return rows


def about(report: BenchmarkReport) -> list[str]:
    """What the tables' signs mean, and where they come from."""
    boot = report.bootstrap
    alpha = 1 - boot.level
    lines = [
        f"protocol {report.outline.protocol}; mean ± standard deviation (n − 1) over training runs with different "
        f"seeds: the chance between runs",
        f"intervals: {boot.resamples} bootstrap resamples of the sentences, seed {boot.seed}: the chance between "
        f"sentences, with the trained models as they are",
        "p over sentences: permutation test by signs, paired by sentence; p over runs: Welch's t-test between training "
        "runs; the larger of the two is corrected after Holm for the rows of one score",
        f"a star, bold (best) and underlined (second best): corrected p below {alpha:.2g}; best and second best only "
        f"where they differ so from every row behind them, corrected for those alone; references are never marked; "
        f"where nothing is marked, the data do not say which is best",
        "still face and mean face never move; shuffled speech is the model given another sentence's speech",
    ]
    factors = [row.cost.factor for table in report.tables for row in table.rows if row.cost.factor is not None]
    machines = {
        f"{each.machine.get('gpu') or each.machine.get('processor')}, {each.machine.get('threads')} thread(s)"
        for each in report.results
        if each.machine.get("processor") and not each.problem
    }
    if factors:
        lines.append(
            f"RTF: seconds of computing for a second of speech, in batches as in the test; memory: the most of "
            f"training and test; on {'; '.join(sorted(machines))}"
        )
    lines += report.remarks
    lines += [f"no result yet: {name}" for name in report.missing]
    lines += [f"failed: {problem}" for problem in report.failed]
    codes = sorted({" ".join(each.code.values()) for each in report.results if each.code})
    lines.append(
        f"facediff {', '.join(codes)}" + (f"; made by `{report.outline.command}`" if report.outline.command else "")
    )
    return lines


def replace_block(path: Path, report: BenchmarkReport) -> None:
    """Put the tables into a Markdown page, between two comments that bear the plan's name.

    Raises:
        FaceDiffError: if the page has no such comments.
    """
    name = report.outline.name
    begin, end = BEGIN.format(name=name), END.format(name=name)
    text = path.read_text(encoding="utf-8")
    if text.count(begin) != 1 or text.count(end) != 1 or text.index(end) < text.index(begin):
        raise FaceDiffError(
            f"{path}: has no place for {name}; write the two lines  {begin}  and  {end}  where it shall be"
        )
    # Headings of the page stand above those of the tables.
    body = "\n".join(f"#{line}" if line.startswith("#") else line for line in markdown_body(report))
    text = f"{text[: text.index(begin)]}{begin}\n\n{body}\n\n{text[text.index(end) :]}"
    with atomic(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


# LaTeX.


def latex(report: BenchmarkReport) -> str:
    """Tables for a paper, with the package booktabs."""
    lines = ["% \\usepackage{booktabs}"]
    for table in report.tables:
        lines += latex_table(table, report)
    return "\n".join([*lines, ""])


def latex_table(table: Table, report: BenchmarkReport) -> list[str]:
    """One table."""
    scale = scales(table)
    emphasis = {"best": r"\textbf{%s}", "second": r"\underline{%s}", "": "%s"}
    head = []
    for column, better in table.columns.items():
        power = f" $/10^{{{scale[column].exponent}}}$" if scale[column].exponent else ""
        head.append(f"{tex(title_of(column))}{power}{tex(arrow(better))}")
    lines = [
        *(r"\begin{table}", r"\centering"),
        rf"\caption{{{tex(report.outline.title)}: {tex(table.title)}. Protocol {tex(report.outline.protocol)}; "
        rf"mean $\pm$ standard deviation over training runs; {table.sequences} sentences, {table.frames} frames.}}",
        rf"\begin{{tabular}}{{l{'r' * (len(head) + 1 + len(COSTS))}}}",
        r"\toprule",
        " & ".join(["", *head, "runs", *COSTS]) + r" \\",
        r"\midrule",
    ]
    references = False
    for row in table.rows:
        if row.reference and not references:
            lines.append(r"\midrule")
            references = True
        cells = [
            emphasis[row.marks.get(column, "")] % tex(mean_and_deviation(row, column, scale[column]))
            for column in table.columns
        ]
        lines.append(" & ".join([tex(row.label), *cells, *map(tex, [runs_of(row), *cost_cells(row)])]) + r" \\")
    return [*lines, r"\bottomrule", r"\end{tabular}", r"\end{table}", ""]


# CSV.

NOTHING = Difference(0.0, None, None, None, None, None, 0)
"""Of the row that all others are compared with."""


def csv_rows(report: BenchmarkReport) -> list[dict[str, Any]]:
    """One flat row for each table, row and score."""
    return [row for table in report.tables for row in _csv_rows(table, report)]


def _csv_rows(table: Table, report: BenchmarkReport) -> Iterator[dict[str, Any]]:
    for row in table.rows:
        for column, scores in row.scores.items():
            interval = row.intervals.get(column)
            found, adjusted = row.differences.get(column, (NOTHING, None))

            def ends(name: str, value: Interval | None) -> dict[str, float | None]:
                return (
                    {f"{name}_low": None, f"{name}_high": None}
                    if value is None
                    else {
                        f"{name}_low": value.low,
                        f"{name}_high": value.high,
                    }
                )

            yield {
                **{"corpus": table.corpus, "split": table.split, "row": row.name, "label": row.label},
                **{"score": column, "protocol": report.outline.protocol, "mean": scores.mean},
                **{"deviation_over_runs": scores.deviation, "runs": len(row.seeds)},
                "seeds": " ".join(str(seed) for seed in row.seeds if seed is not None),
                **ends("sentences", interval),
                "mark": row.marks.get(column, ""),
                "difference": None if found is NOTHING else found.value,
                **ends("difference_sentences", found.sentences),
                "p_sentences": found.p_sentences,
                **ends("difference_runs", found.runs),
                "p_runs": found.p_runs,
                "p_corrected": adjusted,
                "printed": table.published.scores.get(row.name, {}).get(column),
                **{"frames": table.frames, "sentences": row.clips, "parameters": row.cost.parameters},
                **{"real_time_factor": row.cost.factor, "training_seconds": row.cost.training},
                "memory_bytes": row.cost.memory,
            }


# HTML.

STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; margin: 0.6rem 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; white-space: normal; }
thead th { border-top: 2px solid; border-bottom: 1px solid; } tbody tr:last-child td { border-bottom: 2px solid; }
.best { font-weight: bold; } .second { text-decoration: underline; } .reference { font-style: italic; color: #444; }
.scroll { overflow-x: auto; } figure { display: inline-block; margin: 0 1rem 1rem 0; } figcaption { font-size: 13px; }
.warning { border: 1px solid #b55; padding: 0.4rem 0.8rem; display: inline-block; }
@media (prefers-color-scheme: dark) { body { background: #16181c; color: #e6e6e6; } .reference { color: #bbb; }
  svg { background: #fff; } }
"""


def page(report: BenchmarkReport) -> str:
    """The report as one file that needs no network."""
    outline, e = report.outline, html_text
    parts = [f"<h1>{e(outline.title)}</h1>"]
    parts += [f"<p>{e(outline.description)}</p>"] if outline.description else []
    if any(table.synthetic for table in report.tables):
        parts.append('<p class="warning">Synthetic data: what follows says nothing about real people.</p>')
    drawn = panels(report)
    for place, table in enumerate(report.tables):
        parts += [f"<h2>{e(table.title)}</h2>", *_html_table(table, report)]
        own = [panel for name, panel in drawn.items() if name.startswith(f"{place}_")]
        parts += [f"<figure>{panel.svg}<figcaption>{e(panel.caption)}</figcaption></figure>" for panel in own]
    parts += ["<h2>What the numbers are</h2><ul>", *(f"<li>{e(line)}</li>" for line in about(report)), "</ul>"]
    parts.append(f"<pre>{e(report.definition)}</pre>")
    head = f'<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>{e(outline.title)}</title>'
    body = "\n".join(parts)
    return (
        f'<!doctype html>\n<html lang="en"><head>{head}<style>{STYLE}</style></head>\n<body>\n{body}\n</body></html>\n'
    )


def _html_table(table: Table, report: BenchmarkReport) -> Iterator[str]:
    scale = scales(table)
    paper = [column for column in table.columns if any(column in each for each in table.published.scores.values())]
    head = ["", *(head_of(column, scale[column]) + arrow(better) for column, better in table.columns.items())]
    head += [f"{title_of(column)}, printed" for column in paper] + ["runs", *COSTS]
    rows: list[list[str]] = []
    marks: dict[tuple[int, int], str] = {}
    for place, row in enumerate(table.rows):
        printed = table.published.scores.get(row.name, {})
        cells = [mean_and_deviation(row, column, scale[column]) for column in table.columns]
        cells += [scale[column].number(printed.get(column)) for column in paper]
        rows.append([row.label, *cells, runs_of(row), *cost_cells(row)])
        marks |= {(place, number): row.marks.get(column, "") for number, column in enumerate(table.columns, 1)}
    yield html_table(head, rows, kinds=["reference" if row.reference else "" for row in table.rows], marks=marks)
    yield f"<p>{100 * report.bootstrap.level:.0f} % intervals over sentences (bootstrap)</p>"
    intervals = [
        [row.label, *(scale[column].interval(row.intervals.get(column)) for column in table.columns)]
        for row in table.rows
    ]
    yield html_table(["", *(head_of(column, scale[column]) for column in table.columns)], intervals)
    comparisons = comparison_rows(table, report)
    if comparisons:
        yield f"<p>Against {html_text(table.row(table.baseline).label)}</p>"
        yield html_table(COMPARISON, comparisons)
    notes = [f"{table.frames} frames, {table.sequences} sentences", *table.notes]
    notes += [f"printed figures: {source}" for source in table.published.sources] + list(table.published.reasons)
    yield f"<ul>{''.join(f'<li>{html_text(note)}</li>' for note in notes)}</ul>"


def panels(report: BenchmarkReport) -> dict[str, Panel]:
    """The plots of all tables: error over steps and over time, sentence by sentence, and error over speed."""
    found: dict[str, Panel | None] = {}
    makers: tuple[tuple[str, Callable[[Table, BenchmarkReport], Panel | None]], ...] = (
        ("steps", lambda table, report: curves_plot(table, report, "step")),
        ("time", lambda table, report: curves_plot(table, report, "seconds")),
        ("sentences", scatter_plot),
        ("speed", speed_plot),
    )
    for place, table in enumerate(report.tables):
        for name, make in makers:
            found[f"{place}_{table.corpus}_{table.split}_{name}"] = make(table, report)
    return {name: panel for name, panel in found.items() if panel is not None}


# The terminal.


def text(report: BenchmarkReport) -> str:
    """The main tables for the terminal."""
    lines: list[str] = []
    signs = {"best": " (best)", "second": " (second)", "": ""}
    for table in report.tables:
        scale = scales(table)
        kind = "SYNTHETIC corpus " if table.synthetic else ""
        head = ["", *(head_of(column, scale[column]) for column in table.columns), "runs", *COSTS]
        rows = [
            [
                row.label,
                *(
                    mean_and_deviation(row, column, scale[column])
                    + signs[row.marks.get(column, "")]
                    + ("*" if row.significant(column, report.bootstrap.level) else "")
                    for column in table.columns
                ),
                runs_of(row),
                *cost_cells(row),
            ]
            for row in table.rows
        ]
        lines += [
            "",
            f"{kind}{table.title}: {table.sequences} sentences, {table.frames} frames",
            format_table(head, rows),
        ]
        lines += [f"note: {note}" for note in (*table.notes, *table.published.reasons)]
    lines += ["", *about(report)]
    return "\n".join(printable(line) if "\n" not in line else line for line in lines)
