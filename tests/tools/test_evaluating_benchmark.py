from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "evaluating.py"


@pytest.mark.slow
def test_a_toy_run_gets_the_same_numbers_both_ways_and_prints_ratios() -> None:
    # Large enough that the memory of a corpus stands out from what the interpreter itself takes and gives back.
    words = ["--clips=4", "--frames=50", "--vertices=3000", "--workers=1"]
    done = subprocess.run([sys.executable, SCRIPT, *words], capture_output=True, text=True, check=False, timeout=200)
    assert done.returncode == 0, done.stderr
    scores = {name: float(value) for name, value in re.findall(r"(\w+) (\d\.\d+e[-+]\d+)", done.stdout)}
    # Independent normal errors of sizes 0.01 and 0.008: the mean length of a difference is 1.596 standard deviations.
    assert abs(scores["mve"] / (1.596 * (0.01**2 + 0.008**2) ** 0.5) - 1) < 0.02
    # A squared length of normal offsets spreads by √6 σ².
    assert abs(scores["fdd"] / (6**0.5 * (0.01**2 - 0.008**2)) - 1) < 0.3
    apart = re.search(r"relative difference between the ways: (\S+)", done.stdout)
    assert apart
    assert float(apart[1]) < 1e-6
    rows = [line for line in done.stdout.splitlines() if line.endswith(tuple("0123456789")) and "x " in line]
    assert [row.split("  ")[0] for row in rows] == [
        "whole corpus in memory",
        "facediff, 1 worker",
        "only reading, 1 thread",
    ]
    assert re.search(r"1\.0x +1\.0000$", rows[0])
