"""Tables and progress bars: in full in pipes, silent without a terminal."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.utils.text_tables import format_table, print_table

ROOT = Path(__file__).parents[2]


def test_a_table_aligns_numbers_right_and_shows_brackets_and_long_cells_in_full() -> None:
    long = "x" * 500
    lines = format_table(["file", "clips"], [["[red]a.npy", 3], [long, None]]).splitlines()
    assert lines[0].split() == ["file", "clips"]
    assert lines[1] == "[red]a.npy".ljust(500) + "      3"
    assert lines[2] == f"{long}      -"


def test_a_table_without_titles_or_rows() -> None:
    assert format_table([], [["a", "b"]], left=2) == "a  b"
    assert format_table([], []) == ""
    assert format_table(["a", "b"], []) == "a  b"


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_table_fits_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    print_table(["name", "value"], [["b" * 100, "1"]], stream=stream)
    assert "\x1b[1m" in stream.getvalue()
    assert stream.getvalue().count("b") == 100


def test_a_progress_bar_shows_on_a_terminal_and_leaves_standard_output_alone() -> None:
    program = (
        "from facediff.utils.progress import track\nfor item in track([1, 2], 'counting [x]'): print('item', item)\n"
    )
    master, slave = pty.openpty()
    run = subprocess.run(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=slave,
        text=True,
        timeout=60,
        cwd=ROOT,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "100"},
    )
    os.close(slave)
    shown = os.read(master, 100_000).decode()
    os.close(master)
    assert run.returncode == 0
    assert run.stdout == "item 1\nitem 2\n"
    assert "counting [x]" in shown
    assert "2/2" in shown
