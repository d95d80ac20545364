from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "loading.py"


def test_a_toy_run_reads_all_clips_and_prints_ratios() -> None:
    words = ["--clips=3", "--frames=30", "--vertices=200", "--window=10", "--epochs=2", "--only=windows of 10 with"]
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if "x memory" in line]
    assert len(rows) == 3
    assert re.search(r"file by file .* 1\.00 x clips/s, [01]\.000 x memory", rows[0])
    # A window is a third of a clip, so a row's frames and clips a second stand in that proportion.
    clips, frames = map(float, re.split(r"\s{2,}", rows[2])[1:3])
    assert abs(frames / clips - 10) < 0.5
