"""Looking at files in processes: all of them are looked at even if one kills its process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from facediff.data.check.check import Died, run_all

ROOT = Path(__file__).parents[2]


def deadly(task: int) -> int:
    if task == 3:
        os._exit(9)
    return task * task


def test_a_task_that_kills_its_process_is_found_out() -> None:
    results = dict(run_all(deadly, range(6), workers=2))
    assert isinstance(results.pop(3), Died)
    assert results == {task: task * task for task in (0, 1, 2, 4, 5)}


def test_one_worker_starts_no_process() -> None:
    pids = [result for _, result in run_all(lambda task: os.getpid(), [1, 2], workers=1)]
    assert pids == [os.getpid()] * 2


def test_where_processes_cannot_start_this_one_does_the_work() -> None:
    """A program from standard input cannot be started again in another process."""
    program = (
        "from facediff.data.check.check import run_all\n"
        "assert [result for _, result in run_all((2).__pow__, [1, 2, 3], 2)] == [2, 4, 8]\n"
    )
    run = subprocess.run([sys.executable, "-"], input=program, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert run.returncode == 0, run.stderr


def test_worker_processes_import_nothing_heavy() -> None:
    program = "import sys, facediff.data.check.clip; assert not {'torch', 'lightning', 'trimesh'} & set(sys.modules)"
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert run.returncode == 0, run.stderr
