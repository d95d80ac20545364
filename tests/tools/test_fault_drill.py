"""The fault drill covers every command that writes, and sees what it is there to see."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.cli.app import COMMANDS
from tools import fault_drill
from tools.drill_commands import DRILLS, FIT, SERVES, WRITES_NOTHING, Drill
from tools.fault_drill import COUNTS, Driller, Run, Score, table, tree

ROOT = Path(__file__).parents[2]


def test_every_command_is_drilled_or_writes_nothing() -> None:
    drilled = {drill.command for drill in DRILLS}
    assert drilled | {FIT} | {*WRITES_NOTHING} | {*SERVES} == set(COMMANDS)
    assert not drilled & {*WRITES_NOTHING}
    assert len({drill.name for drill in DRILLS}) == len(DRILLS)


@pytest.fixture
def driller(tmp_path: Path) -> Driller:
    """A driller of a command that replaces ``a.txt`` and writes ``b.txt``, without anything that was run."""
    made = Driller.__new__(Driller)
    made.drill = Drill("view", "-o a.txt")
    made.what = "round"
    made.score = Score()
    (tmp_path / "work").mkdir()
    write(tmp_path, "a.txt", "old")
    write(tmp_path, "input.wav", "speech")
    made.before = tree(tmp_path / "work")
    write(tmp_path, "a.txt", "new")
    write(tmp_path, "b.txt", "new")
    made.after = tree(tmp_path / "work")
    return made


def write(place: Path, name: str, text: str) -> None:
    (place / "work" / name).write_text(text)


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [
        ("a.txt", "half", "corrupt"),
        ("a.txt", None, "lost"),
        ("a.txt", "old", ""),
        ("b.txt", "half", "corrupt"),
        ("b.txt", None, ""),
        ("input.wav", None, "lost"),
        ("input.wav", "other", "corrupt"),
        (".b.partial", "half", "left over"),
    ],
)
def test_files_after_a_fault_are_old_or_new(
    driller: Driller, tmp_path: Path, name: str, text: str | None, count: str
) -> None:
    if text is None:
        (tmp_path / "work" / name).unlink()
    else:
        write(tmp_path, name, text)
    driller.judge_files(tmp_path, clean=True)
    assert dict(driller.score.counts) == ({count: 1} if count else {})


@pytest.mark.parametrize(
    ("name", "text", "count"),
    [("a.txt", "old", "wrong"), ("b.txt", None, "lost"), ("c.txt", "more", "left over"), ("a.txt", "new", "")],
)
def test_files_after_the_next_run_are_those_of_an_uninterrupted_one(
    driller: Driller, tmp_path: Path, name: str, text: str | None, count: str
) -> None:
    if text is None:
        (tmp_path / "work" / name).unlink()
    else:
        write(tmp_path, name, text)
    driller.judge_result(tmp_path)
    assert dict(driller.score.counts) == ({count: 1} if count else {})


@pytest.mark.parametrize(
    ("status", "error", "mannered"),
    [
        (0, "", True),
        (2, "facediff: error: a.npz: is damaged; write it again\n", True),
        (1, "Traceback (most recent call last):\n  …\nKeyError: 'a'\n", False),
        (7, "facediff: error: one\n", False),
    ],
)
def test_manners(driller: Driller, status: int, error: str, mannered: bool) -> None:
    driller.judge_manners(Run(status, "", error, 1.0), (0, 1, 2))
    assert bool(driller.score.counts) != mannered
    assert set(driller.score.counts) <= {"ill-mannered"}


def test_what_a_clock_wrote_makes_no_difference(tmp_path: Path) -> None:
    for name, seconds in (("one", 1.5), ("two", 2.5)):
        place = tmp_path / name / "work"
        place.mkdir(parents=True)
        (place / "metrics.csv").write_text(f"step,loss,epoch_time\n0,0.5,{seconds}\n")
        (place / "a.json").write_text(json.dumps({"seconds": seconds, "path": f"{place}/speech.wav", "seed": 3}))
    assert tree(tmp_path / "one") == tree(tmp_path / "two")
    (tmp_path / "two" / "work" / "metrics.csv").write_text("step,loss,epoch_time\n0,0.25,2.5\n")
    assert tree(tmp_path / "one") != tree(tmp_path / "two")


def test_the_table_counts_rounds_and_findings() -> None:
    bad = Score(3, 2)
    bad.note("corrupt", "a.npz")
    text = table({"view": {"kill": Score(4, 3), "full": Score(2, 1)}, "fit": {"kill": bad}})
    head, _, view, fit, everything = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()]
    assert head == ["command", *fault_drill.FAULTS, *COUNTS]
    assert view == ["`view`", "3", "0", "2", *"00000"]
    assert fit == ["`fit`", "2", "0", "0", "0", "1", "0", "0", "0"]
    assert everything == ["all", "5", "0", "2", "0", "1", "0", "0", "0"]


def test_the_small_disk_is_small(tmp_path: Path) -> None:
    try:
        disk = fault_drill.Disk(tmp_path / "disk")
    except subprocess.CalledProcessError:
        pytest.skip("no file system can be mounted here")
    try:
        disk.fill(100_000)
        with pytest.raises(OSError, match="No space left"):
            (disk.folder / "big").write_bytes(bytes(200_000))
        disk.free()
        (disk.folder / "big").write_bytes(bytes(200_000))
    finally:
        disk.close()


@pytest.mark.slow
def test_a_drill_of_one_command(tmp_path: Path) -> None:
    words = ["--only", "figure training", "--kills", "3", "--stops", "1", "--full", "1"]
    done = subprocess.run(
        [sys.executable, "tools/fault_drill.py", *words, "--markdown", str(tmp_path / "table.md")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=280,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "| `figure training` | 3 | 1 | 1 | 0 | 0 | 0 | 0 | 0 |" in (tmp_path / "table.md").read_text()
