from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "viewer.py"


def test_a_toy_run_prints_a_line_for_each_motion() -> None:
    words = ["--vertices=600", "--seconds=4", "--watch=0.3"]
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if " vertices, " in line]
    assert len(rows) == 4
    megabytes = [float(re.split(r"  +", row)[1]) for row in rows]
    assert all(0 < size < 1 for size in megabytes)
    assert megabytes[2] > megabytes[0]  # noise is the worst case
