"""Running many tasks: all are done even if one kills its process, in each of the modes."""

from __future__ import annotations

import os
import subprocess
import sys
import threading
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

from facediff.errors import MissingExtraError
from facediff.utils.jobs import PerWorker, SetupError, run_tasks
from facediff.utils.workers import Mode, WorkerDied
from tests.fakes.tasks import counting, deadly, failing_setup, raising, square

ROOT = Path(__file__).parents[2]
MODES: list[Mode] = ["processes", "threads", "serial"]


def note_threads(_: int) -> str | None:
    return os.environ.get("OMP_NUM_THREADS")


@pytest.mark.parametrize("mode", MODES)
def test_every_mode_yields_every_task_with_its_result(mode: Mode) -> None:
    assert dict(run_tasks(square, range(20), workers=2, mode=mode)) == {task: task * task for task in range(20)}
    assert list(run_tasks(square, [], workers=2, mode=mode)) == []


def test_a_task_that_kills_its_process_is_found_and_loses_no_other() -> None:
    results = dict(run_tasks(deadly, range(6), workers=2))
    assert isinstance(results.pop(3), WorkerDied)
    assert results == {task: task * task for task in (0, 1, 2, 4, 5)}


def test_one_worker_starts_no_process() -> None:
    assert [result for _, result in run_tasks(lambda _: os.getpid(), [1, 2], workers=1)] == [os.getpid()] * 2


@pytest.mark.parametrize("mode", MODES)
def test_the_first_error_is_raised_and_can_be_pickled(mode: Mode) -> None:
    with pytest.raises(MissingExtraError, match="h5py"):
        list(run_tasks(raising, range(8), workers=2, mode=mode))


def test_set_up_happens_once_in_each_worker() -> None:
    results = [result for _, result in run_tasks(PerWorker(partial(counting, 10)), range(8), workers=2)]
    by_process: dict[int, list[int]] = {}
    for result in results:
        assert isinstance(result, tuple)
        by_process.setdefault(result[0], []).append(result[1])
    assert os.getpid() not in by_process
    for counts in by_process.values():
        assert sorted(counts) == list(range(11, 11 + len(counts)))


@pytest.mark.parametrize("workers", [1, 2])
def test_a_failing_set_up_raises_an_error_of_its_own(workers: int) -> None:
    with pytest.raises(SetupError, match=r"C\.ckpt"):
        list(run_tasks(PerWorker(failing_setup), range(3), workers=workers))


def test_worker_processes_compute_on_one_thread_and_leave_the_parent_alone() -> None:
    before = os.environ.get("OMP_NUM_THREADS")
    assert {result for _, result in run_tasks(note_threads, range(2), workers=2)} == {"1"}
    assert os.environ.get("OMP_NUM_THREADS") == before


def test_results_are_bounded_by_the_workers_while_nobody_takes_them() -> None:
    begun: list[int] = []
    go_on = threading.Event()

    def work(task: int) -> int:
        begun.append(task)
        go_on.wait(0.05)
        return task

    with closing(run_tasks(work, range(50), workers=2, mode="threads")) as results:
        next(results)
        go_on.wait(0.3)
        assert len(begun) <= 4
    assert len(begun) <= 4  # what had not been begun is dropped


def test_where_processes_cannot_start_this_one_does_the_work() -> None:
    """A program from standard input cannot be started again in another process."""
    program = (
        "from facediff.utils.jobs import run_tasks\n"
        "assert [result for _, result in run_tasks((2).__pow__, [1, 2, 3], workers=2)] == [2, 4, 8]\n"
    )
    run = subprocess.run([sys.executable, "-"], input=program, capture_output=True, text=True, timeout=60, cwd=ROOT)
    assert run.returncode == 0, run.stderr
