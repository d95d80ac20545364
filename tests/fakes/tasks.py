"""Tasks for workers, in a module that costs a new process nothing to import."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from facediff.errors import FaceDiffError, MissingExtraError


def square(task: int) -> int:
    """A number for a number."""
    return task * task


def deadly(task: int) -> int:
    """One of the tasks kills its process."""
    if task == 3:
        os._exit(9)
    return task * task


def raising(task: int) -> int:
    """One of the tasks raises an error."""
    if task == 1:
        raise MissingExtraError("h5py", "prepare", "reading")
    return task


def failing_oddly(task: int) -> int:
    """One of the tasks has a bug."""
    if task == 1:
        raise RuntimeError("a bug")
    return task


def failing_setup() -> Callable[[int], int]:
    """What every task needs is not there."""
    raise FaceDiffError("C.ckpt: no such checkpoint")


def place(_: int) -> tuple[int, str, str | None, str | None]:
    """Where a task runs: process, folder, threads, and a variable of facediff's."""
    return os.getpid(), os.getcwd(), os.environ.get("OMP_NUM_THREADS"), os.environ.get("FACEDIFF_TRIAL")


def counting(base: int = 0) -> Callable[[int], tuple[int, int]]:
    """A set-up whose tasks count how often it has been used."""
    calls: list[int] = []

    def work(task: int) -> tuple[int, int]:
        calls.append(task)
        time.sleep(0.02)
        return os.getpid(), base + len(calls)

    return work


def write_slowly(folder: Path, task: int) -> int:
    """Write a file whole or not at all; all but the first take a minute."""
    from facediff.utils.files import atomic

    with atomic(folder / f"{task}.txt") as temporary:
        temporary.write_text("half")
        if task:
            (folder / f"begun{task}").touch()
            time.sleep(60)
    return task
