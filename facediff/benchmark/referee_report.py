"""The referee's report as Markdown, HTML, CSV and JSON, and as text for the terminal."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from facediff.benchmark.referee import SCORES, Judgement
from facediff.reporting.documents import (
    BEST,
    NONE,
    Block,
    Bullets,
    Paragraph,
    ReportTable,
    Title,
    html_page,
    markdown,
    terminal_text,
    write_texts,
)
from facediff.synthetic.spoken_set import LANGUAGES, SpokenClip
from facediff.utils.plain_files import write_json, write_rows

NAME = "referee"
ARROWS = {"higher": " ↑", "lower": " ↓", "zero": " →0", "one": " →1"}


@dataclass(frozen=True)
class RefereeReport:
    """The referee's verdict on all models, with the motion of the built-in corpus as the reference."""

    clips: Sequence[SpokenClip]
    reference: Judgement
    rows: Sequence[Judgement]
    command: str
    code: Mapping[str, str]
    machine: str


def write_report(report: RefereeReport, folder: Path) -> list[Path]:
    """Write all forms into a folder; the files."""
    blocks = document(report)
    files = write_texts(folder, {f"{NAME}.md": markdown(blocks), f"{NAME}.html": html_page("Referee", blocks)})
    write_rows(folder / f"{NAME}.csv", csv_rows(report))
    write_json(folder / f"{NAME}.json", content(report))
    return [*files, folder / f"{NAME}.csv", folder / f"{NAME}.json"]


def text(report: RefereeReport) -> str:
    """For the terminal."""
    return "\n" + terminal_text([scores_table(report), *languages_and_costs(report)])


def document(report: RefereeReport) -> list[Block]:
    """The whole report."""
    languages = {LANGUAGES[clip.language].name for clip in report.clips}
    return [
        Title("Referee"),
        Paragraph(
            "Synthetic speech and a synthetic face: models are compared with the phonemes, not with people.",
            warning=True,
        ),
        scores_table(report),
        *languages_and_costs(report),
        Title("Definitions", 2),
        Bullets(
            [
                *(f"{score.title}: {score.meaning}" for score in SCORES.values()),
                "the reference is the built-in corpus's own motion for the same speech: its mouth follows from the "
                "phonemes, its brows, blinks and head are one of many performances; models that were trained on that "
                "corpus know its way of speaking",
                f"{len(report.clips)} sentences, {sum(clip.seconds for clip in report.clips):.0f} s, in "
                f"{', '.join(sorted(languages))}; voices "
                f"{', '.join(dict.fromkeys(clip.voice for clip in report.clips))}",
                f"processor seconds for a second of speech, loading left out; memory is the whole process's; on "
                f"{report.machine}",
                f"facediff {' '.join(report.code.values())}; made by `{report.command}`",
            ]
        ),
    ]


def scores_table(report: RefereeReport) -> ReportTable:
    """A row for each model, and the reference."""
    rows = [[row.name, *_cells(row.scores)] for row in [*report.rows, report.reference]]
    marks: dict[tuple[int, int], str] = {}
    for column, (name, score) in enumerate(SCORES.items(), 1):
        values = [
            (score.badness(row.scores[name]), index) for index, row in enumerate(report.rows) if name in row.scores
        ]
        if score.ideal is not None and len(values) > 1:
            best = min(values)[0]
            marks |= {(index, column): BEST for value, index in values if value == best}
    head = ["", *(score.title + ARROWS.get(str(score.ideal), "") for score in SCORES.values())]
    return ReportTable(head, rows, marks, frozenset({len(report.rows)}))


def _cells(scores: Mapping[str, float]) -> list[str]:
    return [f"{scores[name]:.{score.digits}f}" if name in scores else NONE for name, score in SCORES.items()]


def languages_and_costs(report: RefereeReport) -> list[Block]:
    """Closures in each language, costs and licences, and the reasons why models were not scored."""
    languages = list(dict.fromkeys(clip.language for clip in report.clips))
    rows = []
    for row in report.rows:
        closed = [row.scores.get(f"closures_{code}") for code in languages]
        cost = [
            NONE if row.seconds is None else f"{row.seconds:.3g}",
            NONE if row.memory is None else f"{row.memory / 2**20:.0f} MiB",
            NONE if row.problem else f"{row.frame_rate:g}",
        ]
        shares = [NONE if share is None else f"{share:.2f}" for share in closed]
        rows.append([row.name, *shares, *cost, row.facts.get("commercial use", "unknown")])
    head = ["closures in", *(LANGUAGES[code].name for code in languages), "CPU s/s", "memory", "fps", "commercial use"]
    notes = [
        f"{row.name}: {title}: {value}"
        for row in report.rows
        for title, value in row.facts.items()
        if title != "commercial use"
    ]
    notes += [f"{row.name}: not scored: {row.problem}" for row in report.rows if row.problem]
    return [ReportTable(head, rows), Bullets(notes)]


def csv_rows(report: RefereeReport) -> list[dict[str, Any]]:
    """One row for each model, and the reference."""
    names = [*SCORES, *(f"closures_{code}" for code in LANGUAGES)]
    return [
        {"model": row.name}
        | {name: row.scores.get(name) for name in names}
        | {"cpu_seconds_per_second": row.seconds, "memory_bytes": row.memory, "problem": row.problem}
        for row in [*report.rows, report.reference]
    ]


def content(report: RefereeReport) -> dict[str, Any]:
    """Everything as plain data."""
    return {
        "command": report.command,
        "code": dict(report.code),
        "machine": report.machine,
        "clips": [
            {name: getattr(clip, name) for name in ("name", "language", "voice", "text", "seconds")}
            for clip in report.clips
        ],
        "rows": [
            {
                "name": row.name,
                "scores": dict(row.scores),
                "facts": dict(row.facts),
                "cpu_seconds_per_second": row.seconds,
                "memory_bytes": row.memory,
                "frame_rate": row.frame_rate,
                "problem": row.problem,
            }
            for row in [*report.rows, report.reference]
        ],
    }
