"""Progress where no terminal is: a line a minute, and nothing of what is quick or quiet."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from facediff.utils import progress


def counted(monkeypatch: pytest.MonkeyPatch, steps: int, seconds: float, total: int | None, **options: int) -> None:
    """Count steps that take so many seconds each."""
    now = [100.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    with progress.progress_bar("voices", total, **options) as step:
        for _ in range(steps):
            now[0] += seconds
            step()


def test_a_log_gets_a_line_a_minute_with_the_time_that_is_left(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counted(monkeypatch, 10, 25.0, 10)
    # Every third step ends more than a minute after the last line.
    wanted = ["voices: 3 of 10, 3 min left", "voices: 6 of 10, 2 min left", "voices: 9 of 10, 1 min left"]
    assert capsys.readouterr().err.splitlines() == wanted
    # Of one step nobody knows how long it takes.
    counted(monkeypatch, 3, 60.0, 12, done=8)
    assert capsys.readouterr().err.splitlines() == [
        "voices: 9 of 12",
        "voices: 10 of 12, 2 min left",
        "voices: 11 of 12, 1 min left",
    ]
    counted(monkeypatch, 1, 60.0, None)
    assert capsys.readouterr().err.splitlines() == ["voices: 1"]


def test_what_is_quick_quiet_or_at_its_end_says_nothing(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    counted(monkeypatch, 59, 1.0, 100)
    counted(monkeypatch, 1, 600.0, 1)
    counted(monkeypatch, 10, 600.0, 10, shown=False)
    assert capsys.readouterr().err == ""
