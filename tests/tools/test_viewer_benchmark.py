from __future__ import annotations

import re
from pathlib import Path

import pytest

from tests.fakes.processes import run

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "viewer.py"


@pytest.mark.slow  # the pages that it measures are tested in tests/export/viewer
def test_a_toy_run_prints_a_line_for_each_motion() -> None:
    words = ["--vertices=600", "--seconds=4", "--watch=0.3"]
    done = run(SCRIPT, *words)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if " vertices, " in line]
    assert len(rows) == 4
    megabytes = [float(re.split(r"  +", row)[1]) for row in rows]
    assert all(0 < size < 1 for size in megabytes)
    assert megabytes[2] > megabytes[0]  # noise is the worst case
