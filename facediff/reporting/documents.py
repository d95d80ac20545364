"""One document, written as Markdown, as a page for the browser, as LaTeX, and as text for the terminal.

A document is a list of blocks. Cells of tables are plain text without markup: each form escapes its special characters.
A cell that is None becomes –.
"""

from __future__ import annotations

import html
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from facediff.errors import printable
from facediff.utils.files import atomic
from facediff.utils.text_tables import format_table

NONE = "–"
BEST, SECOND = "best", "second"
EMPHASIS: dict[str, dict[str, str]] = {
    "markdown": {BEST: "**{}**", SECOND: "<u>{}</u>"},
    "latex": {BEST: r"\textbf{{{}}}", SECOND: r"\underline{{{}}}"},
    "terminal": {BEST: "{} (best)", SECOND: "{} (second)"},
}
STYLE = """
body { font: 15px/1.45 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; color: #1a1a1a; }
table { border-collapse: collapse; margin: 0.6rem 0 1.2rem; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.7rem; text-align: right; white-space: nowrap; }
th:first-child, td:first-child { text-align: left; white-space: normal; }
thead th { border-top: 2px solid; border-bottom: 1px solid; } tbody tr:last-child td { border-bottom: 2px solid; }
.best { font-weight: bold; } .second { text-decoration: underline; } .reference { font-style: italic; color: #444; }
.scroll { overflow-x: auto; }
.warning { border: 1px solid #b55; padding: 0.4rem 0.8rem; display: inline-block; }
@media (prefers-color-scheme: dark) { body { background: #16181c; color: #e6e6e6; } .reference { color: #bbb; } }
"""


@dataclass(frozen=True)
class Title:
    """A title; level 1 is the document's."""

    text: str
    level: int = 1


@dataclass(frozen=True)
class Paragraph:
    """A paragraph; a warning is set off."""

    text: str
    warning: bool = False


@dataclass(frozen=True)
class Bullets:
    """Lines one below the other."""

    lines: Sequence[str]


@dataclass(frozen=True)
class ReportTable:
    """A table with the first column aligned to the left."""

    head: Sequence[str]
    rows: Sequence[Sequence[object]]
    marks: Mapping[tuple[int, int], str] = field(default_factory=dict)  # ``best`` or ``second``, by row and column
    # Numbers of the rows that are set apart from the compared ones; they stand last
    references: frozenset[int] = frozenset()
    caption: str = ""  # below the table in LaTeX

    def cells(self, form: str, escape: Callable[[object], str]) -> list[list[str]]:
        """The cells of a form, escaped and with their marks."""
        emphasis = EMPHASIS.get(form, {})
        return [
            [
                emphasis.get(self.marks.get((index, column), ""), "{}").format(escape(NONE if cell is None else cell))
                for column, cell in enumerate(row)
            ]
            for index, row in enumerate(self.rows)
        ]


Block = Title | Paragraph | Bullets | ReportTable


def between(low: float, high: float, show: Callable[[float], str]) -> str:
    """An interval in brackets; – if it is not known."""
    return f"[{show(low)}, {show(high)}]" if math.isfinite(low) and math.isfinite(high) else NONE


def p_value(value: float | None) -> str:
    """A p value; – if it is not known."""
    return NONE if value is None else "<0.001" if value < 0.001 else f"{value:.3f}"


def write_texts(folder: Path, texts: Mapping[str, str]) -> list[Path]:
    """Write texts by the names of their files, each whole or not at all; the files."""
    for name, content in texts.items():
        with atomic(folder / name) as temporary:
            temporary.write_text(content, encoding="utf-8", errors="backslashreplace")
    return [folder / name for name in texts]


# Markdown.


def markdown(blocks: Iterable[Block]) -> str:
    """A document in Markdown."""
    return "\n\n".join(map(_markdown, blocks)) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Title():
            return f"{'#' * block.level} {markdown_text(block.text)}"
        case Paragraph():
            first, colon, rest = markdown_text(block.text).partition(":")
            return f"**{first}**{colon}{rest}" if block.warning else f"{first}{colon}{rest}"
        case Bullets():
            return "\n".join(f"- {markdown_text(line)}" for line in block.lines)
        case ReportTable():
            rows = block.cells("markdown", markdown_text)
            for index in block.references:
                rows[index][0] = f"*{rows[index][0]}*"
            return _markdown_lines([markdown_text(title) for title in block.head], rows)


def _markdown_lines(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], f"|---|{'---:|' * (len(head) - 1)}", *lines[1:]])


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    r"""A table in Markdown.

    Example:
        >>> print(markdown_table(["", "share"], [["a|b", 0.5]]))
        |  | share |
        |---|---:|
        | a\|b | 0.5 |
    """
    return _markdown(ReportTable(head, list(rows)))


def markdown_text(text: object) -> str:
    r"""Text that Markdown shows as it is; text between backticks is code, in which only bars are special.

    Example:
        >>> print(markdown_text("`a_b|c` and x_y"))
        `a_b\|c` and x\_y
    """
    parts = printable(text).split("`")
    if len(parts) % 2 == 0:
        parts = ["`".join(parts)]
    for index, part in enumerate(parts):
        parts[index] = part.replace("|", "\\|") if index % 2 else re.sub(r"([\\|<>*_`\[\]]|^#)", r"\\\1", part)
    return "`".join(parts)


# LaTeX.

_LATEX = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
_LATEX |= {letter: f"\\{letter}" for letter in "&%$#_{}"}
_LATEX |= {letter: f"${letter}$" for letter in "<>|"}  # which the usual fonts of text do not have
_LATEX |= {
    "±": r"$\pm$",
    "−": "$-$",
    "–": "--",
    "α": r"$\alpha$",
    "↑": r"$\uparrow$",
    "↓": r"$\downarrow$",
    "→": r"$\to$",
}


def latex(tables: Iterable[ReportTable]) -> str:
    """Tables for a paper, with the package booktabs."""
    return "\n\n".join(["% \\usepackage{booktabs}", *map(_latex_table, tables)]) + "\n"


def _latex_table(table: ReportTable) -> str:
    rows = [" & ".join(row) + r" \\" for row in table.cells("latex", latex_text)]
    if table.references:
        rows.insert(min(table.references), r"\midrule")
    head = " & ".join(re.sub(r"/1e(-?\d+)", r"$/10^{\1}$", latex_text(title)) for title in table.head)
    lines = [r"\begin{table}", r"\centering", rf"\begin{{tabular}}{{l{'r' * (len(table.head) - 1)}}}", r"\toprule"]
    lines += [head + r" \\", r"\midrule", *rows, r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\caption{{{latex_text(table.caption)}}}"] if table.caption else []
    return "\n".join([*lines, r"\end{table}"])


def latex_text(text: object) -> str:
    r"""Text that LaTeX shows as it is.

    Example:
        >>> latex_text("50 % of a_b < 1")
        '50 \\% of a\\_b $<$ 1'
    """
    return "".join(_LATEX.get(letter, letter) for letter in printable(text))


# HTML.


def html_page(title: str, blocks: Iterable[Block]) -> str:
    """A document as one file that loads nothing."""
    # Names of methods come from elsewhere: even if one were not escaped, no program and no address would be used.
    policy = "default-src 'none'; style-src 'unsafe-inline'"
    head = (
        f'<meta http-equiv="Content-Security-Policy" content="{policy}"><meta charset="utf-8">'
        f'<meta name="viewport" content="width=device-width"><title>{html_text(title)}</title><style>{STYLE}</style>'
    )
    body = "\n".join(map(_html, blocks))
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n{body}\n</body></html>\n'


def _html(block: Block) -> str:
    match block:
        case Title():
            return f"<h{block.level}>{html_text(block.text)}</h{block.level}>"
        case Paragraph():
            return f"<p{_css('warning' if block.warning else '')}>{html_text(block.text)}</p>"
        case Bullets():
            return f"<ul>{''.join(f'<li>{html_text(line)}</li>' for line in block.lines)}</ul>"
        case ReportTable():
            return _html_table(block)


def _html_table(table: ReportTable) -> str:
    titles = "".join(f'<th scope="col">{html_text(title)}</th>' for title in table.head)
    lines = []
    for index, row in enumerate(table.cells("html", html_text)):
        marks = [table.marks.get((index, column), "") for column in range(len(row))]
        cells = [f"<td{_css(mark)}>{cell}</td>" for mark, cell in zip(marks, row, strict=True)]
        lines.append(f"<tr{_css('reference' if index in table.references else '')}>{''.join(cells)}</tr>")
    body = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{titles}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _css(name: str) -> str:
    return f' class="{html.escape(name)}"' if name else ""


def html_text(text: object) -> str:
    """Text that a page shows as it is; its lines stay lines.

    Example:
        >>> html_text("a < b")
        'a &lt; b'
    """
    return "\n".join(html.escape(printable(line)) for line in str(text).split("\n"))


# The terminal.


def terminal_text(blocks: Iterable[Block]) -> str:
    """A document as text for the terminal; a blank line ends every block but a title."""
    lines: list[str] = []
    for block in blocks:
        match block:
            case Title():
                lines.append(printable(block.text))
            case Paragraph():
                lines += [printable(block.text), ""]
            case Bullets():
                lines += [*map(printable, block.lines), ""]
            case ReportTable():
                lines += [format_table(block.head, block.cells("terminal", str)), ""]
    return "\n".join(lines).rstrip("\n")
