from __future__ import annotations

import re
import runpy
from pathlib import Path

import pytest

from tests.fakes.processes import run

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "loading.py"


@pytest.mark.slow
def test_a_toy_run_reads_all_clips_and_prints_ratios() -> None:
    words = ["--clips=3", "--frames=30", "--vertices=200", "--window=10", "--epochs=2", "--only=windows of 10 with"]
    done = run(SCRIPT, *words, timeout=200)
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if "x memory" in line]
    assert len(rows) == 3
    assert re.search(r"file by file .* 1\.00 x clips/s, [01]\.000 x memory", rows[0])
    # A window is a third of a clip, so a row's frames and clips a second stand in that proportion.
    clips, frames = map(float, re.split(r"\s{2,}", rows[2])[1:3])
    assert abs(frames / clips - 10) < 0.5


def test_every_way_reads_all_frames(tmp_path: Path) -> None:
    """In this process, where the memory that each way takes means nothing."""
    tool = runpy.run_path(str(SCRIPT))
    tool["write_corpus"](tmp_path, 3, 30, 20)
    args = tool["parser"]().parse_args(["--root", str(tmp_path), "--epochs=2", "--window=10", "--vertices=20"])
    ways = {name: list(read()) for name, read in tool["ways"](args).items() if "workers" not in name}
    assert len(ways) == 5
    for name, frames in ways.items():
        assert frames == [10 if "windows" in name else 30] * 6, name
