"""Tables for the terminal and for pipes; :mod:`facediff.reporting` has tables for documents."""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from typing import TextIO

from facediff.errors import printable

UNLIMITED = 100_000  # width of a table that nothing cuts, in characters


def format_table(head: Sequence[str], rows: Iterable[Sequence[object]], *, left: int = 1) -> str:
    """A table as plain text: no colours, no frame, every cell in full; None becomes ``-``.

    The first ``left`` columns are aligned to the left, the others, numbers as a rule, to the right.
    """
    stream = io.StringIO()
    print_table(head, rows, left=left, stream=stream)
    return "\n".join(line.rstrip() for line in stream.getvalue().splitlines())


def print_table(
    head: Sequence[str], rows: Iterable[Sequence[object]], *, left: int = 1, stream: TextIO | None = None
) -> None:
    """Print a table of :func:`format_table`: within the width of a terminal, or as plain text in full elsewhere."""
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
    for column, title in enumerate(columns):
        table.add_column(Text(printable(title)), justify="left" if column < left else "right", overflow="fold")
    for row in cells:
        table.add_row(*row)
    console.print(table)
