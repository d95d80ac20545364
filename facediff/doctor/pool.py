"""Looking at many clips in several processes; a file that kills the process which reads it is found out."""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from typing import Any, Generic, TypeVar

from facediff.errors import MissingExtraError
from facediff.processes import start_worker, unheard

Task = TypeVar("Task")
Result = TypeVar("Result")

_work: Callable[[Any], Any] | None = None


class Died(Generic[Task]):
    """Stands for the result of a task that killed its process.

    Args:
        task: the task.
    """

    def __init__(self, task: Task) -> None:
        self.task = task


@contextmanager
def steps(total: int, *, shown: bool) -> Iterator[Callable[[], object]]:
    """A progress bar on standard error, if it is a terminal; what is given is called after each clip."""
    if not shown:
        yield lambda: None
        return
    try:
        from tqdm import tqdm
    except ImportError as error:
        raise MissingExtraError("tqdm", "prepare", "the progress bar (--quiet does without)") from error
    with tqdm(total=total, desc="clips", unit="clip", disable=None) as bar:
        yield bar.update


def run_all(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, Result | Died[Task]]]:
    """Results as they come; in this process if there is one worker.

    Args:
        work: a function of a module, or a partial of one; it goes to each process once.
        tasks: what it is called with.
        workers: number of processes.
    """
    if min(workers, len(tasks)) <= 1 or not _can_start():
        for task in tasks:
            yield task, work(task)
        return
    left = dict(enumerate(tasks))
    with _pool(work, workers) as pool:
        with unheard():
            running = {pool.submit(_do, task): index for index, task in left.items()}
        try:
            for future in as_completed(running):
                result = future.result()
                yield left.pop(running[future]), result
        except BrokenProcessPool:
            pass  # found out below
        finally:
            _drop(running)
    yield from _one_by_one(work, list(left.values()))


def _can_start() -> bool:
    """Whether processes start at all: from standard input, or a script without a main guard, they do not.

    Without arguments: handing much to a process that dies at its start blocks for ever (as of Python 3.11).
    """
    try:
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
            return pool.submit(os.getpid).result() != os.getpid()
    except BrokenProcessPool:
        return False


def _one_by_one(work: Callable[[Task], Result], tasks: Sequence[Task]) -> Iterator[tuple[Task, Result | Died[Task]]]:
    """With one task in one process at a time it is known which task killed the process."""
    waiting = list(reversed(tasks))
    while waiting:
        with _pool(work, 1) as pool:
            while waiting:
                task = waiting.pop()
                try:
                    with unheard():
                        future = pool.submit(_do, task)
                    yield task, future.result()
                except BrokenProcessPool:
                    yield task, Died(task)
                    break


def _pool(work: Callable[[Any], Any], workers: int) -> ProcessPoolExecutor:
    # Never a plain fork: the caller may have started threads.
    return ProcessPoolExecutor(
        workers, mp_context=multiprocessing.get_context("spawn"), initializer=_start, initargs=(work,)
    )


def _drop(futures: dict[Future[Any], int]) -> None:
    for future in futures:
        future.cancel()


def _start(work: Callable[[Any], Any]) -> None:
    global _work
    start_worker()
    _work = work


def _do(task: Any) -> Any:  # noqa: ANN401
    return _work(task) if _work is not None else None
