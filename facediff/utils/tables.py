"""Tables for the terminal, for pipes, and for documents."""

from __future__ import annotations

import html
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import TextIO

from facediff.errors import printable

UNLIMITED = 100_000  # width of a table that nothing cuts, in characters


def format_table(head: Sequence[str], rows: Iterable[Sequence[object]], *, left: int = 1) -> str:
    """A table as plain text: no colours, no frame, every cell in full.

    Args:
        head: titles of the columns; no titles if empty.
        rows: cells; None becomes ``-``.
        left: how many columns, from the left, are aligned to the left. The others, numbers as a rule, are aligned to
            the right.

    Example:
        >>> print(format_table(["split", "clips"], [["train", 192], ["test", 24]]))
        split  clips
        train    192
        test      24
    """
    stream = io.StringIO()
    print_table(head, rows, left=left, stream=stream)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def print_table(
    head: Sequence[str], rows: Iterable[Sequence[object]], *, left: int = 1, stream: TextIO | None = None
) -> None:
    """Print a table: with bold titles and within the width of a terminal, or as plain text in full anywhere else.

    The arguments are those of :func:`format_table`; ``stream`` is standard output if None.
    """
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console(file=stream, highlight=False)
    if not console.is_terminal:
        console = Console(file=stream, highlight=False, width=UNLIMITED, color_system=None)
    # Text and not str: brackets in a file's name are no markup.
    cells = [[Text("-" if cell is None else printable(cell)) for cell in row] for row in rows]
    table = Table(box=None, padding=(0, 2, 0, 0), pad_edge=False, show_header=bool(head), header_style="bold")
    columns = head or [""] * max(map(len, cells), default=0)
    for place, title in enumerate(columns):
        table.add_column(Text(printable(title)), justify="left" if place < left else "right", overflow="fold")
    for row in cells:
        table.add_row(*row)
    console.print(table)


# The same as text for documents. Cells are text; None becomes –.

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


def latex_text(text: object) -> str:
    r"""Text that LaTeX shows as it is.

    Example:
        >>> latex_text("50 % of a_b < 1")
        '50 \\% of a\\_b $<$ 1'
    """
    return "".join(_LATEX.get(letter, letter) for letter in printable(text))


def latex_table(head: Sequence[str], rows: Iterable[Sequence[object]], *, caption: str = "") -> str:
    """A table for a paper, with the package booktabs; the first column is aligned to the left.

    Args:
        head: titles of the columns.
        rows: cells.
        caption: below the table; none if empty.
    """
    lines = [r"\begin{table}", r"\centering", rf"\begin{{tabular}}{{l{'r' * (len(head) - 1)}}}", r"\toprule"]
    lines += [" & ".join(map(latex_text, head)) + r" \\", r"\midrule"]
    lines += [" & ".join(latex_text(_cell(cell)) for cell in row) + r" \\" for row in rows]
    lines += [r"\bottomrule", r"\end{tabular}"]
    lines += [rf"\caption{{{latex_text(caption)}}}"] if caption else []
    return "\n".join([*lines, r"\end{table}"])


def markdown_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    r"""A table in Markdown.

    Example:
        >>> print(markdown_table(["", "share"], [["a|b", 0.5]]))
        |  | share |
        |---|---:|
        | a\|b | 0.5 |
    """
    lines = [list(head), *([_cell(cell) for cell in row] for row in rows)]
    shown = ["| " + " | ".join(_markdown(cell) for cell in line) + " |" for line in lines]
    return "\n".join([shown[0], f"|---|{'---:|' * (len(head) - 1)}", *shown[1:]])


def html_text(text: object) -> str:
    """Text that a page shows as it is; its lines stay lines.

    Example:
        >>> html_text("a < b")
        'a &lt; b'
    """
    return "\n".join(html.escape(printable(line)) for line in str(text).split("\n"))


def html_table(
    head: Sequence[str],
    rows: Iterable[Sequence[object]],
    *,
    kinds: Sequence[str] = (),
    marks: Mapping[tuple[int, int], str] | None = None,
) -> str:
    """A table for a page.

    Args:
        head: titles of the columns.
        rows: cells.
        kinds: CSS class of each row; none where it is empty.
        marks: CSS class of single cells, by row and column.

    Example:
        >>> print(html_table(["", "LVE"], [["ours", 1.5]], marks={(0, 1): "best"}))
        <div class="scroll"><table><thead><tr><th scope="col"></th><th scope="col">LVE</th></tr></thead><tbody>
        <tr><td>ours</td><td class="best">1.5</td></tr>
        </tbody></table></div>
    """

    def opened(name: str, kind: str) -> str:
        return f'<{name} class="{html.escape(kind)}">' if kind else f"<{name}>"

    titles = "".join(f'<th scope="col">{html_text(text)}</th>' for text in head)
    lines = []
    for place, row in enumerate(rows):
        cells = (
            f"{opened('td', (marks or {}).get((place, column), ''))}{html_text(_cell(cell))}</td>"
            for column, cell in enumerate(row)
        )
        lines.append(f"{opened('tr', kinds[place] if place < len(kinds) else '')}{''.join(cells)}</tr>")
    body = "\n".join(lines)
    return f'<div class="scroll"><table><thead><tr>{titles}</tr></thead><tbody>\n{body}\n</tbody></table></div>'


def _cell(cell: object) -> str:
    return "–" if cell is None else str(cell)


def _markdown(text: str) -> str:
    special = "\\`*_{}[]<>|#"
    return "".join(f"\\{letter}" if letter in special else letter for letter in printable(text))
