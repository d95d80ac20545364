"""The report of a study as Markdown, LaTeX, CSV, JSON and a page, and as text for the terminal.

The main table has the form of the paper's table 4: a row for each comparison with the first method, and a column for
each data set, of which each is a study of its own.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from facediff.reporting.documents import (
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
from facediff.study.analysis import Preference, StudyReport, answers_of
from facediff.study.definition import SAME
from facediff.utils.plain_files import json_text, write_rows

Cells = list[list[str | None]]


def write_report(reports: Sequence[StudyReport], folder: Path) -> list[Path]:
    """Write all forms into a folder; the files.

    ``table.*`` is the table, ``report.*`` is everything, and ``answers.*`` holds every single answer.
    """
    files = write_texts(
        folder,
        {
            "report.md": markdown(blocks(reports)),
            "report.html": html_page("User study", blocks(reports)),
            "table.tex": latex(main_table(reports, question) for question in questions(reports)),
            "report.json": json_text("report.json", {"studies": [report.as_dict() for report in reports]}) + "\n",
        },
    )
    for name, rows in (
        ("table.csv", [_preference_row(report, pair) for report in reports for pair in report.preferences]),
        ("answers.csv", [row for report in reports for row in _answers(report)]),
        ("comments.csv", comments(reports)),
    ):
        if rows:
            write_rows(folder / name, rows)
            files.append(folder / name)
    return files


# The blocks of a report.


def percent(share: float, digits: int = 2) -> str:
    """A share as the paper prints it."""
    return f"{100 * share:.{digits}f}"


def questions(reports: Sequence[StudyReport]) -> list[str]:
    """Names of the questions of all studies, in order."""
    return list(dict.fromkeys(question.name for report in reports for question in report.study.choices))


def main_table(reports: Sequence[StudyReport], question: str) -> ReportTable:
    """Table 4: how often the first method was preferred, in percent with an interval; a column a data set."""
    pairs = dict.fromkeys(
        (preference.first, preference.second)
        for report in reports
        for preference in report.preferences
        if preference.question == question and preference.first == report.study.methods[0]
    )
    rows: Cells = []
    for first, second in pairs:
        shares = (report.preference(question, first, second) for report in reports)
        rows.append([f"{first} and {second}", *(None if share is None else share_of(share) for share in shares)])
    counts = "; ".join(f"{report.name}: {len(report.counted)} raters" for report in reports)
    return ReportTable(
        ["preferred, %", *(report.name for report in reports)],
        rows,
        caption=f"User study, {question}: how often the first method of each pair was preferred, in %, with Wilson "
        f"intervals of {100 * reports[0].level:g} %. {counts}.",
    )


def share_of(preference: Preference) -> str:
    """A share with its interval."""
    return f"{percent(preference.share)} {between(*preference.interval, percent)}"


def pair_table(report: StudyReport, question: str) -> ReportTable:
    """Every pair of a study with all its numbers."""
    head = ["pair", "answers", "first %", "wilson", "between raters", "p", "p corrected"]
    ties = any(preference.same for preference in report.preferences)
    rows: Cells = []
    for pair in report.preferences:
        if pair.question == question:
            row: list[str | None] = [f"{pair.first} and {pair.second}", str(pair.answers), percent(pair.share)]
            row += [between(*pair.interval, percent), between(*pair.between_raters, percent)]
            rows.append([*row, p_value(pair.p), p_value(pair.p_corrected), *([str(pair.same)] if ties else [])])
    return ReportTable([*head, "no difference"] if ties else head, rows)


def rater_table(report: StudyReport) -> ReportTable:
    """Numbers of raters, and of exclusions by reason."""
    reasons = Counter(reason.split(" in ")[0] for check in report.checks for reason in check.reasons)
    rows: Cells = [["all", str(len(report.raters))], ["counted", str(len(report.counted))]]
    return ReportTable(["raters", "number"], rows + [[reason, str(count)] for reason, count in sorted(reasons.items())])


def facts(report: StudyReport) -> list[str]:
    """Definitions of the numbers, in sentences."""
    rule, level = report.study.rule, f"{100 * report.level:g} %"
    lines = [
        f"Study {report.study.id}: {len(report.counted)} of {len(report.raters)} raters are counted. The rule was "
        f"fixed when the study was made: at least {rule.least_right:.0%} of the answers to controls name the truth and "
        f"not the still face, at least {rule.least_consistent:.0%} of repeated pairs are answered alike, at most "
        f"{rule.most_on_one_side:.0%} of all answers name one side"
        + (", and everything is answered." if rule.finished else "."),
        f"Intervals are {level} ones: of shares, Wilson's score intervals of single answers; between raters, from "
        "drawing raters again. Quote the latter where raters answer to a comparison more than once.",
        "p is of the exact binomial test against one half, corrected by Holm for the comparisons of a question.",
    ]
    for question, (share, limits, count) in report.sides.items():
        lines.append(
            f"{question}: of {count} answers to the same animation on both sides, {percent(share, 1)} % name the left "
            f"{between(*limits, lambda value: percent(value, 1))}."
        )
    if report.study.remark:
        lines.append(f"Shown were animations of {report.study.remark}.")
    return [*lines, *report.notes]


def blocks(reports: Sequence[StudyReport]) -> list[Block]:
    """The whole report."""
    document: list[Block] = [Title("User study")]
    for question in questions(reports):
        document += [Title(question, 2), main_table(reports, question)]
        for report in reports:
            document += [Title(f"{question}: {report.name}", 3), pair_table(report, question)]
    for report in reports:
        document += [Title(f"Raters: {report.name}", 2), rater_table(report), Bullets(facts(report))]
    return document


def text(report: StudyReport) -> str:
    """The report for the terminal."""
    title = f"{report.name}: {len(report.counted)} of {len(report.raters)} raters are counted"
    document: list[Block] = [Paragraph(title)]
    for question in questions([report]):
        document += [Title(question, 2), pair_table(report, question)]
    return terminal_text([*document, rater_table(report), Bullets(facts(report))])


# Plain data.


def _preference_row(report: StudyReport, preference: Preference) -> dict[str, Any]:
    low, high = (end if math.isfinite(end) else None for end in preference.between_raters)
    return {
        "study": report.name,
        "question": preference.question,
        "first": preference.first,
        "second": preference.second,
        "answers": preference.answers,
        "wins": preference.wins,
        "losses": preference.losses,
        SAME: preference.same,
        "share": preference.share,
        "level": report.level,
        "low": preference.interval[0],
        "high": preference.interval[1],
        "raters_low": low,
        "raters_high": high,
        "p": preference.p,
        "p_corrected": preference.p_corrected,
        "raters": len(report.counted),
    }


def _answers(report: StudyReport) -> Iterator[dict[str, Any]]:
    included = {rater.token for rater in report.counted}
    for rater in report.raters:
        for trial, question, answer in answers_of(rater, report.study.by_id):
            stored = rater.answers[trial.id]
            yield {
                "study": report.name,
                "rater": rater.token,
                "number": rater.number,
                "code": rater.code,
                "language": rater.language,
                "counted": rater.token in included,
                "trial": trial.id,
                "kind": trial.kind,
                "clip": trial.clip,
                "left": trial.left,
                "right": trial.right,
                "question": question,
                "answer": answer,
                "chosen": trial.preferred(answer) or "",
                "seconds": stored.seconds,
                "plays": stored.plays,
                "at": stored.at,
            }


def comments(reports: Sequence[StudyReport]) -> list[dict[str, Any]]:
    """One flat row for every free text."""
    return [
        {"study": report.name, "rater": rater.token, "language": rater.language, "question": question, "text": text}
        for report in reports
        for rater in report.raters
        for question, text in rater.comments.items()
    ]
