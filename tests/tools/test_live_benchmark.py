"""The benchmark of live performances: its click track arrives at every socket."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "tools" / "benchmarks"


@pytest.mark.slow
def test_every_click_arrives_within_half_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("pythonosc")
    monkeypatch.syspath_prepend(str(FOLDER))
    rows = importlib.import_module("live").clicks(3.0).splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    assert [name for name, *_ in cells] == ["Live Link Face", "VMC", "JSON lines"]
    for _, count, *lags in cells:
        assert int(count) == 4
        median, _, worst = (int(lag.removesuffix(" ms")) for lag in lags)
        assert 10 < median <= worst < 500
