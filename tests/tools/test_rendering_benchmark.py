"""The benchmark of rendering."""

from pathlib import Path

import pytest

from tests.fakes.processes import run

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "rendering.py"


@pytest.mark.slow
def test_video_prints_a_line_for_each_face() -> None:
    done = run(SCRIPT, "video", "--seconds=0.2", "--size=48", "--rounds=1")
    assert done.returncode == 0, done.stderr
    rows = [line for line in done.stdout.splitlines() if "this version" in line]
    assert [row.split()[-1] for row in rows] == ["1.00", "1.00"]
