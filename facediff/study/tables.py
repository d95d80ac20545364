"""The report of a study as Markdown, LaTeX, CSV, JSON and a page, and as text for the terminal.

The main table has the form of the paper's table 4: a row for each comparison with the first method, and a column for
each data set, of which each is a study of its own.
"""

from __future__ import annotations

import html
import json
import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from facediff.errors import printable
from facediff.study.definition import SAME
from facediff.study.report import Preference, StudyReport, answers_of
from facediff.utils.files import atomic
from facediff.utils.plain_files import json_text, write_rows
from facediff.utils.tables import format_table, html_table, latex_table, markdown_table

Cells = list[list[str | None]]

STYLE = """
body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 60rem; padding: 0 1rem;
  color: #1a1d23; background: #fff; }
table { border-collapse: collapse; margin: .6rem 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .8rem; text-align: right; } th:first-child, td:first-child { text-align: left; }
thead th { border-top: 2px solid; border-bottom: 1px solid; } tbody tr:last-child td { border-bottom: 2px solid; }
.scroll { overflow-x: auto; } figure { margin: 1rem 0; } figcaption { font-size: .9rem; }
svg { max-width: 100%; height: auto; } svg text { fill: currentColor; font-size: 13px; }
@media (prefers-color-scheme: dark) { body { background: #16181c; color: #e6e8ec; } }
"""
WIDTH, LEFT_EDGE, ROW = 720, 260, 26


def write_report(reports: Sequence[StudyReport], folder: Path) -> list[Path]:
    """Write all forms into a folder; the files.

    ``table.*`` is the table, ``report.*`` is everything, and ``answers.*`` holds every single answer.
    """
    texts: dict[str, str] = {
        "report.md": markdown(reports),
        "report.html": page(reports),
        "table.tex": latex(reports),
        "report.json": json_text("report.json", {"studies": [report.as_dict() for report in reports]}) + "\n",
        "answers.json": json_text("answers.json", {"answers": answer_rows(reports), "comments": comments(reports)})
        + "\n",
    }
    files = []
    for name, content in texts.items():
        with atomic(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8", errors="backslashreplace")
        files.append(folder / name)
    for name, rows in (("table.csv", preference_rows(reports)), ("answers.csv", answer_rows(reports))):
        if rows:
            write_rows(folder / name, rows)
            files.append(folder / name)
    if rows := comments(reports):
        write_rows(folder / "comments.csv", rows)
        files.append(folder / "comments.csv")
    return files


# Tables of texts, from which every form is made.


def percent(share: float, digits: int = 2) -> str:
    """A share as the paper prints it."""
    return f"{100 * share:.{digits}f}"


def between(ends: tuple[float, float], show: Callable[[float], str]) -> str:
    """An interval in brackets; – if it is not known."""
    return "–" if not all(map(math.isfinite, ends)) else f"[{show(ends[0])}, {show(ends[1])}]"


def questions(reports: Sequence[StudyReport]) -> list[str]:
    """Names of the questions of all studies, in order."""
    return list(dict.fromkeys(question.name for report in reports for question in report.study.choices))


def main_table(reports: Sequence[StudyReport], question: str) -> tuple[list[str], Cells]:
    """Table 4: how often the first method was preferred, in percent with an interval; a column a data set."""
    pairs = list(
        dict.fromkeys(
            (each.first, each.second)
            for report in reports
            for each in report.preferences
            if each.question == question and each.first == report.study.methods[0]
        )
    )
    head = ["preferred, %", *(report.name for report in reports)]
    rows: Cells = []
    for first, second in pairs:
        cells: list[str | None] = [f"{first} and {second}"]
        for report in reports:
            found = report.preference(question, first, second)
            cells.append(None if found is None else f"{percent(found.share)} {between(found.interval, percent)}")
        rows.append(cells)
    return head, rows


def pair_table(report: StudyReport, question: str) -> tuple[list[str], Cells]:
    """Every pair of a study with everything that is known of it."""
    head = ["pair", "answers", "first %", report.interval, "between raters", "p", "p corrected"]
    head += ["no difference"] if any(each.same for each in report.preferences) else []
    rows: Cells = []
    for each in report.preferences:
        if each.question != question:
            continue
        row: list[str | None] = [f"{each.first} and {each.second}", str(each.answers), percent(each.share)]
        row += [between(each.interval, percent), between(each.between_raters, percent)]
        row += [p_value(each.p), p_value(each.p_corrected)]
        rows.append(row + ([str(each.same)] if "no difference" in head else []))
    return head, rows


def p_value(value: float) -> str:
    """A p value."""
    return "<0.001" if value < 0.001 else f"{value:.3f}"


def score_table(report: StudyReport, question: str) -> tuple[list[str], Cells]:
    """Bradley-Terry scores, the highest first."""
    found = next((each for each in report.scores if each.question == question), None)
    rows: Cells = []
    if found is not None:
        for name, score in sorted(found.scores.items(), key=lambda item: -item[1]):
            rows.append([name, f"{score:+.3f}", between(found.intervals[name], lambda value: f"{value:+.3f}")])
    return ["Bradley-Terry", "score", "interval"], rows


def rater_table(report: StudyReport) -> tuple[list[str], Cells]:
    """Why raters are not counted, and how many."""
    reasons = Counter(reason.split(" in ")[0] for check in report.checks for reason in check.reasons)
    rows: Cells = [["all", str(len(report.raters))], ["counted", str(len(report.counted))]]
    return ["raters", "number"], rows + [[reason, str(count)] for reason, count in sorted(reasons.items())]


def facts(report: StudyReport) -> list[str]:
    """What the numbers are, in sentences."""
    rule, level = report.study.rule, f"{100 * report.level:g} %"
    kind = "Wilson's score" if report.interval == "wilson" else "the exact binomial (Clopper-Pearson)"
    lines = [
        f"Study {report.study.id}: {len(report.counted)} of {len(report.raters)} raters are counted. The rule was "
        f"fixed when the study was made: at least {rule.least_right:.0%} of the answers to controls name the truth and "
        f"not the still face, at least {rule.least_consistent:.0%} of repeated pairs are answered alike, at most "
        f"{rule.most_on_one_side:.0%} of all answers name one side"
        + (", and everything is answered." if rule.finished else "."),
        f"Intervals are {level} ones. Those of shares are {kind} intervals of single answers. Those "
        "between raters come from drawing raters again; quote them where raters answer to a comparison more than once.",
        "p is of the exact binomial test against one half, corrected by Holm for the comparisons of a question.",
    ]
    for scores in report.scores:
        source = "the variance between raters" if scores.robust else "the likelihood of single answers"
        lines.append(f"{scores.question}: intervals of Bradley-Terry scores come from {source}.")
        if not scores.bounded:
            lines.append(
                f"{scores.question}: a condition always won or always lost, so that half a win was added to each side "
                f"of every pair."
            )
    for each in report.agreement:
        alpha = "is not known" if not math.isfinite(each.alpha) else f"is {each.alpha:.3f}"
        shown = between(each.interval, lambda value: f"{value:.3f}")
        lines.append(f"{each.question}: Krippendorff's alpha {alpha} {shown}, over {each.units} videos.")
    for question, (share, ends, count) in report.sides.items():
        lines.append(
            f"{question}: of {count} answers to the same animation on both sides, {percent(share, 1)} % name the left "
            f"{between(ends, lambda value: percent(value, 1))}."
        )
    if report.study.remark:
        lines.append(f"Shown were animations of {report.study.remark}.")
    return [*lines, *report.notes]


def preference_rows(reports: Sequence[StudyReport]) -> list[dict[str, Any]]:
    """One flat row for each study, question and pair."""
    return [_flat(report, each) for report in reports for each in report.preferences]


def _flat(report: StudyReport, each: Preference) -> dict[str, Any]:
    known = math.isfinite(each.between_raters[0])
    return {
        "study": report.name,
        "question": each.question,
        "first": each.first,
        "second": each.second,
        "answers": each.answers,
        "wins": each.wins,
        "losses": each.losses,
        SAME: each.same,
        "share": each.share,
        "level": report.level,
        "interval": report.interval,
        "low": each.interval[0],
        "high": each.interval[1],
        "raters_low": each.between_raters[0] if known else None,
        "raters_high": each.between_raters[1] if known else None,
        "p": each.p,
        "p_corrected": each.p_corrected,
        "raters": len(report.counted),
    }


def answer_rows(reports: Sequence[StudyReport]) -> list[dict[str, Any]]:
    """One flat row for every answer of every rater."""
    return [row for report in reports for row in _answers(report)]


def _answers(report: StudyReport) -> Iterator[dict[str, Any]]:
    counted = {rater.token for rater in report.counted}
    for rater in report.raters:
        for trial, question, answer in answers_of(rater, report.study.by_id):
            given = rater.answers[trial.id]
            yield {
                "study": report.name,
                "rater": rater.token,
                "number": rater.number,
                "code": rater.code,
                "language": rater.language,
                "counted": rater.token in counted,
                "trial": trial.id,
                "kind": trial.kind,
                "clip": trial.clip,
                "left": trial.left,
                "right": trial.right,
                "question": question,
                "answer": answer,
                "chosen": trial.chosen(answer) or "",
                "seconds": given.seconds,
                "plays": given.plays,
                "at": given.at,
            }


def comments(reports: Sequence[StudyReport]) -> list[dict[str, Any]]:
    """One flat row for every free text."""
    return [
        {"study": report.name, "rater": rater.token, "language": rater.language, "question": question, "text": text}
        for report in reports
        for rater in report.raters
        for question, text in rater.comments.items()
    ]


# Forms.


def markdown(reports: Sequence[StudyReport]) -> str:
    """The report in Markdown."""
    parts = ["# User study"]
    for question in questions(reports):
        parts += [f"## {question}", markdown_table(*main_table(reports, question))]
        for report in reports:
            parts += [f"### {question}: {report.name}", markdown_table(*pair_table(report, question))]
            head, rows = score_table(report, question)
            parts += [markdown_table(head, rows)] if rows else []
    for report in reports:
        parts += [f"## Raters: {report.name}", markdown_table(*rater_table(report))]
        parts.append("\n".join(f"- {line}" for line in facts(report)))
    return "\n\n".join(parts) + "\n"


def latex(reports: Sequence[StudyReport]) -> str:
    """The main tables for a paper."""
    lines = ["% \\usepackage{booktabs}"]
    for question in questions(reports):
        counts = "; ".join(f"{report.name}: {len(report.counted)} raters" for report in reports)
        kind = {"wilson": "Wilson", "binomial": "exact binomial"}[reports[0].interval]
        caption = (
            f"User study, {question}: how often the first method of each pair was preferred, in %, with {kind} "
            f"intervals of {100 * reports[0].level:g} %. {counts}."
        )
        lines.append(latex_table(*main_table(reports, question), caption=caption))
    return "\n\n".join(lines) + "\n"


def text(report: StudyReport) -> str:
    """The report for the terminal."""
    lines = [f"{report.name}: {len(report.counted)} of {len(report.raters)} raters are counted"]
    for question in report.study.choices:
        lines += ["", question.name, format_table(*pair_table(report, question.name))]
        head, rows = score_table(report, question.name)
        lines += ["", format_table(head, rows)] if rows else []
    lines += ["", format_table(*rater_table(report)), "", *facts(report)]
    return "\n".join(lines)


def page(reports: Sequence[StudyReport]) -> str:
    """The report as one page that loads nothing."""
    escape = html.escape
    parts = ["<h1>User study</h1>"]
    for question in questions(reports):
        parts += [f"<h2>{escape(question)}</h2>", html_table(*main_table(reports, question))]
        for report in reports:
            name = escape(printable(report.name))
            parts += [f"<h3>{name}</h3>", plot(report, question), html_table(*pair_table(report, question))]
            head, rows = score_table(report, question)
            parts += [html_table(head, rows)] if rows else []
    for report in reports:
        parts += [f"<h2>Raters: {escape(printable(report.name))}</h2>", html_table(*rater_table(report))]
        parts.append("<ul>" + "".join(f"<li>{escape(printable(line))}</li>" for line in facts(report)) + "</ul>")
    meta = '<meta charset="utf-8"><meta name="viewport" content="width=device-width"><title>User study</title>'
    policy = "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'\">"
    body = "\n".join(parts)
    meta = f"{policy}{meta}<style>{STYLE}</style>"
    return f'<!doctype html>\n<html lang="en"><head>{meta}</head>\n<body>\n{body}\n</body></html>\n'


def plot(report: StudyReport, question: str) -> str:
    """Shares with their intervals, as SVG."""
    rows = [each for each in report.preferences if each.question == question]
    high = ROW * len(rows) + 40

    def x(share: float) -> float:
        return LEFT_EDGE + share * (WIDTH - LEFT_EDGE - 20)

    parts = []
    for tick in (0, 0.25, 0.5, 0.75, 1):
        dash = "" if tick == 0.5 else ' stroke-dasharray="2 4"'
        parts.append(f'<line x1="{x(tick):.1f}" x2="{x(tick):.1f}" y1="5" y2="{high - 30}" stroke="#888"{dash}/>')
        parts.append(f'<text x="{x(tick):.1f}" y="{high - 10}" text-anchor="middle">{100 * tick:g} %</text>')
    for index, each in enumerate(rows):
        y = ROW * index + 20
        label = html.escape(printable(f"{each.first} and {each.second}"))
        parts.append(f'<text x="{LEFT_EDGE - 12}" y="{y + 4}" text-anchor="end">{label}</text>')
        low, end = each.interval
        parts.append(f'<line x1="{x(low):.1f}" x2="{x(end):.1f}" y1="{y}" y2="{y}" stroke="#0b7285" stroke-width="3"/>')
        parts.append(f'<circle cx="{x(each.share):.1f}" cy="{y}" r="5" fill="#0b7285"/>')
    words = html.escape(printable(f"Share of the first of each pair, with its interval: {question}, {report.name}"))
    drawing = (
        f'<svg viewBox="0 0 {WIDTH} {high}" width="{WIDTH}" role="img" aria-label="{words}">{"".join(parts)}</svg>'
    )
    return f"<figure>{drawing}<figcaption>{words}</figcaption></figure>"


def json_report(reports: Sequence[StudyReport]) -> str:
    """Everything as JSON."""
    return json.dumps({"studies": [report.as_dict() for report in reports]}, indent=2, ensure_ascii=True)
