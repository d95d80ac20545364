"""The tables of a benchmark, from the results of its cells: one for each corpus and test split."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from facediff.benchmark.outline import ReportOutline
from facediff.benchmark.plan import COSTS, MEAN_SUFFIX
from facediff.benchmark.published import PublishedScores, shown_tables
from facediff.benchmark.results import Result
from facediff.benchmark.significance import Difference, RowScores, compared, follows_speech, marked
from facediff.reporting.scores import ScoreMatrix
from facediff.reporting.statistics import Bootstrap, Interval
from facediff.utils import ranges

REFERENCE_LABELS = {
    "still": "still face",
    "mean_face": "speaker's mean face",
    "shuffled": "{row}, shuffled speech",
}
SIGNS = {"lower": 1, "higher": -1}
SPLIT_LABELS = {
    "test_a": "test A, seen speakers",
    "test_b": "test B, unseen speakers",
    "test_c": "test C, unseen voices",
}


@dataclass(frozen=True)
class Cost:
    """Costs of a row, mean over its runs."""

    parameters: int | None = None
    factor: float | None = None  # real-time factor: seconds of computing for a second of speech
    training: float | None = None  # seconds
    memory: float | None = None  # bytes, the most of any step


@dataclass(frozen=True)
class TableRow:
    """A row of a table."""

    name: str  # by which the plan calls it
    label: str  # by which the table calls it
    seeds: tuple[int | None, ...]  # of its training runs
    reference: bool  # whether it is none of the compared methods
    scores: Mapping[str, RowScores]  # by column
    intervals: Mapping[str, Interval | None]  # over sentences, by column
    marks: Mapping[str, str] = field(default_factory=dict)  # ``best`` or ``second``, by column
    # From the baseline, with the corrected p-value, by column
    differences: Mapping[str, tuple[Difference, float | None]] = field(default_factory=dict)
    cost: Cost = Cost()
    clips: int = 0  # sentences that it was scored on

    def significant(self, column: str, level: float) -> bool:
        """Whether the difference from the baseline is larger than chance explains."""
        adjusted = self.differences[column][1] if column in self.differences else None
        return adjusted is not None and adjusted < 1 - level


@dataclass(frozen=True)
class Table:
    """One corpus, one test split, or the ``shares`` of its clips that were tested."""

    corpus: str
    label: str
    split: str
    synthetic: bool
    costs: tuple[str, ...]  # of COSTS
    columns: Mapping[str, str | None]  # score to ``lower``, ``higher``, ``zero`` or None
    rows: list[TableRow]
    baseline: str
    frames: int
    sequences: int
    regions: Mapping[str, Any]
    notes: list[str]
    published: PublishedScores
    shares: tuple[float, ...] = ()

    @property
    def title(self) -> str:
        """Corpus and split in words."""
        some = "".join(f", a sub-sample of {100 * share:.4g} %" for share in self.shares)
        return f"{self.label}, {SPLIT_LABELS.get(self.split, self.split)}{some}"

    def row(self, name: str) -> TableRow:
        """A row by its name."""
        return next(row for row in self.rows if row.name == name)


@dataclass(frozen=True)
class BenchmarkReport:
    """All tables of a benchmark, with their intervals and definitions."""

    outline: ReportOutline
    tables: list[Table]
    bootstrap: Bootstrap
    definition: str
    results: list[Result]
    pending: list[str]  # cells without a result
    failed: list[str]  # why cells failed
    remarks: list[str]


def report_of(
    outline: ReportOutline,
    results: Sequence[Result],
    pending: Sequence[str] = (),
    *,
    baseline: str | None = None,
    resamples: ranges.Resamples = 2000,
    level: ranges.Level = 0.95,
    seed: ranges.Seed = 0,
) -> BenchmarkReport:
    """Make the tables."""
    bootstrap = Bootstrap(resamples, level, seed)
    scored = [result for result in results if not result.problem]
    failed = [result.problem for result in results if result.problem]
    tables = []
    for corpus in outline.corpora:
        of_corpus = [result for result in scored if result.corpus == corpus]
        splits = dict.fromkeys(str(row["split"]) for result in of_corpus for row in result.scores)
        tables += [_table(outline, of_corpus, corpus, split, baseline, bootstrap) for split in splits]
    definition = "\n".join(dict.fromkeys(line for result in scored for line in result.definition.splitlines()))
    return BenchmarkReport(
        outline, tables, bootstrap, definition, list(results), list(pending), failed, _remarks(scored)
    )


def _remarks(results: Sequence[Result]) -> list[str]:
    """Unwanted differences between the cells of one benchmark."""
    remarks = []
    for what, values in (
        ("versions of the code", {(" ".join(result.code.values())) for result in results}),
        ("machines", {str(result.machine.get("gpu") or result.machine.get("processor")) for result in results}),
        ("threads", {str(result.machine.get("threads")) for result in results}),
    ):
        if len(values) > 1:
            remarks.append(f"the cells are of several {what}: {', '.join(sorted(values))}")
    return remarks


def _table(
    outline: ReportOutline,
    results: Sequence[Result],
    corpus: str,
    split: str,
    baseline: str | None,
    bootstrap: Bootstrap,
) -> Table:
    groups = {name: [result for result in results if result.row == name] for name in outline.rows}
    groups = {name: group for name, group in groups.items() if any(_row_of(result, split, "model") for result in group)}
    first = next(iter(groups.values()))[0]
    columns = _columns(outline, [result for group in groups.values() for result in group], split)
    stated = (name for name in (baseline, outline.baseline) if name and name.removesuffix(MEAN_SUFFIX) in groups)
    baseline = next(stated, next(iter(groups)))
    compared_with = baseline.removesuffix(MEAN_SUFFIX)
    rows = []
    for name, group in groups.items():
        label = outline.rows[name][0]
        rows.append(_row(name, label, group, split, "model", columns, bootstrap))
        if any(_row_of(result, split, "sample_mean") for result in group):
            title = f"{label}, mean of samples"
            rows.append(_row(f"{name}{MEAN_SUFFIX}", title, group, split, "sample_mean", columns, bootstrap))
    for reference in outline.references:
        # A face that does not move is the same in every run; shuffled speech is each method's own.
        still = [result for result in results if _row_of(result, split, reference)][:1]
        of_rows = groups if reference == "shuffled" else {"": still}
        for name, group in of_rows.items():
            if any(_row_of(result, split, reference) for result in group):
                label = REFERENCE_LABELS[reference].format(row=outline.rows[name][0] if name else "")
                title = f"{name}.{reference}" if name else reference
                rows.append(_row(title, label, group, split, reference, columns, bootstrap))
    if all(row.name != baseline for row in rows):  # the mean of a method that draws no samples
        baseline = compared_with
    rows = _with_comparisons(rows, columns, baseline, bootstrap)
    tested = [_row_of(result, split, "model") for result in results]
    scored = _row_of(first, split, "model") or {}
    clips = {clip for row in rows for scores in row.scores.values() for clip in scores.clips}
    regions = dict(scored.get("regions") or {})
    frames = int((_row_of(groups[compared_with][0], split, "model") or {"frames": 0})["frames"])
    manifests = {str(result.provenance.get("manifest")) for result in results if result.provenance}
    published = shown_tables(
        outline.published,
        rows={name: outline.rows[name][1] for name in groups},
        corpus=str(first.provenance.get("corpus") or corpus),
        synthetic=first.synthetic,
        split=split,
        protocol=first.protocol,
        lips=dict(regions.get("lips") or {}),
        frames=frames,
        sequences=len(clips),
    )
    return Table(
        corpus=corpus,
        label=outline.corpora[corpus],
        split=split,
        synthetic=any(result.synthetic for result in results),
        costs=tuple(name for name in outline.columns if name in COSTS) or COSTS,
        columns={name: facts.get("better") for name, facts in columns.items()},
        rows=rows,
        baseline=baseline,
        frames=frames,
        sequences=len(clips),
        regions=regions,
        notes=[*_notes(rows, columns, len(clips), manifests), *_shuffled_notes(rows, columns, bootstrap)],
        published=published,
        shares=tuple(sorted({row["test_share"] for row in tested if row and "test_share" in row})),
    )


def _row_of(result: Result, split: str, method: str) -> Mapping[str, Any] | None:
    """The scores of a cell for a method on a split."""
    return next((row for row in result.scores if (row["split"], row["method"]) == (split, method)), None)


def _columns(outline: ReportOutline, results: Sequence[Result], split: str) -> dict[str, Mapping[str, str | None]]:
    """The columns of scores, in order, and how each is pooled."""
    scored: dict[str, Mapping[str, str | None]] = {}
    for result in results:
        for name, facts in result.columns.items():
            row = _row_of(result, split, "model")
            if row is not None and row.get(name) is not None:
                scored.setdefault(name, facts)
    names = [name for name in outline.columns if name in scored] or list(scored)
    return {name: scored[name] for name in names}


def _row(
    name: str,
    label: str,
    group: Sequence[Result],
    split: str,
    method: str,
    columns: Mapping[str, Mapping[str, str | None]],
    bootstrap: Bootstrap,
) -> TableRow:
    fixed = method in ("still", "mean_face")
    runs = [result for result in group if _row_of(result, split, method)]
    scores = {}
    for column, facts in columns.items():
        column_scores = _scores(runs, split, method, column, facts.get("pooling"), fixed=fixed)
        if column_scores is not None:
            scores[column] = column_scores
    intervals = {column: column_scores.interval(bootstrap) for column, column_scores in scores.items()}
    cost = Cost() if method != "model" else _cost(runs)
    seeds = tuple(() if fixed else (result.seed for result in runs))
    clips = max((len(column_scores.clips) for column_scores in scores.values()), default=0)
    reference = method not in ("model", "sample_mean")
    return TableRow(name, label, seeds, reference, scores, intervals, cost=cost, clips=clips)


def _scores(
    runs: Sequence[Result], split: str, method: str, column: str, pooling: str | None, *, fixed: bool
) -> RowScores | None:
    totals = [(_row_of(result, split, method) or {}).get(column) for result in runs]
    if not totals or None in totals:
        return None
    scored = np.array(totals, np.float64)
    values: dict[str, list[list[float]]] = {}  # of each clip in each run, several under several identities
    frames: dict[str, float] = {}
    for run, result in enumerate(runs):
        for row in result.sequences:
            if (row["split"], row["method"]) == (split, method) and row.get(column) is not None:
                clip = str(row["clip"])
                values.setdefault(clip, [[] for _ in runs])[run].append(float(row[column]))
                frames[clip] = float(row["frames"])
    if pooling is None or not values:
        return RowScores(scored, fixed=fixed)
    clips = sorted(values)
    # A clip that was scored under several identities is one sentence: the mean of them.
    matrix = np.array([[np.mean(some) if some else np.nan for some in values[clip]] for clip in clips])
    weights = np.array([[frames[clip] if pooling == "frames" else 1.0] for clip in clips])
    return RowScores(scored, ScoreMatrix.of(clips, matrix, np.broadcast_to(weights, matrix.shape)), fixed)


def _cost(runs: Sequence[Result]) -> Cost:
    def mean(values: Sequence[float | None]) -> float | None:
        measured = [value for value in values if value is not None]
        return sum(measured) / len(measured) if measured else None

    parameters = next((result.parameters for result in runs if result.parameters is not None), None)
    return Cost(
        parameters,
        mean([result.real_time_factor() for result in runs]),
        mean([result.training_seconds for result in runs]),
        max((result.memory for result in runs if result.memory is not None), default=None),
    )


def _with_comparisons(
    rows: Sequence[TableRow],
    columns: Mapping[str, Mapping[str, str | None]],
    baseline: str,
    bootstrap: Bootstrap,
) -> list[TableRow]:
    marks: dict[str, dict[str, str]] = {row.name: {} for row in rows}
    differences: dict[str, dict[str, tuple[Difference, float | None]]] = {row.name: {} for row in rows}
    for column, facts in columns.items():
        scores = {row.name: row.scores[column] for row in rows if column in row.scores}
        references = {row.name for row in rows if row.reference}
        methods = {name: score for name, score in scores.items() if name not in references}
        for name, mark in marked(methods, facts.get("better"), bootstrap).items():
            marks[name][column] = mark
        if baseline in scores:
            for name, difference in compared(scores, baseline, bootstrap, references).items():
                differences[name][column] = difference
    return [replace(row, marks=marks[row.name], differences=differences[row.name]) for row in rows]


def _shuffled_notes(
    rows: Sequence[TableRow], columns: Mapping[str, Mapping[str, str | None]], bootstrap: Bootstrap
) -> list[str]:
    """Methods that score as well with another sentence's speech, score by score."""
    shuffled = {row.name.removesuffix(".shuffled"): row.scores for row in rows if row.name.endswith(".shuffled")}
    notes = []
    for column, facts in columns.items():
        sign = SIGNS.get(str(facts.get("better")))
        labels = [
            row.label
            for row in rows
            if sign is not None
            and column in row.scores
            and column in shuffled.get(row.name, {})
            and not follows_speech(row.scores[column], shuffled[row.name][column], sign, bootstrap)
        ]
        if labels:
            notes.append(f"by {column}, another sentence's speech gives equal scores: {', '.join(labels)}")
    return notes


def _notes(
    rows: Sequence[TableRow],
    columns: Mapping[str, Mapping[str, str | None]],
    clips: int,
    manifests: set[str],
) -> list[str]:
    """Notes below the table."""
    notes = []
    methods = [row for row in rows if not row.reference]
    single = [row.label for row in methods if len(row.seeds) == 1]
    if single:
        notes.append(
            f"a single training run: the chance between runs is unknown, and no difference is called significant: "
            f"{', '.join(single)}"
        )
    fewer = [f"{row.label} ({row.clips} of {clips})" for row in rows if row.clips < clips]
    if fewer:
        notes.append(f"not scored on all sentences; compare differences, not scores: {', '.join(fewer)}")
    for column, facts in columns.items():
        sign = SIGNS.get(str(facts.get("better")))
        scored = [row for row in methods if column in row.scores]
        if sign is None or not scored:
            continue
        for row in rows:
            if row.reference and column in row.scores:
                best = min(sign * method.scores[column].mean for method in scored)
                if sign * row.scores[column].mean < best:
                    notes.append(f"by {column}, no method is better than this reference: {row.label}")
    if len(manifests) > 1:
        notes.append("the cells were run on different states of the corpus: their manifests differ")
    return notes
