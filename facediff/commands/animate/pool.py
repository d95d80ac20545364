"""Long pieces of work in several processes, of which one that dies takes nothing but its own piece along."""

from __future__ import annotations

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from facediff.processes import start_worker, unheard

Task = TypeVar("Task")
Result = TypeVar("Result")

_work: Callable[[Any], Any] | None = None


def run_tasks(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int
) -> Iterator[tuple[Task, Result | None]]:
    """Tasks and their results as they come; in this process if there is one worker.

    No worker is handed a task before it is free for it, so that a stop waits for what is at work and no more. Workers
    compute on one thread each, leave Ctrl-C to this process, and end when it ends, however it went.

    Args:
        work: a function of a module, or an object of a module's class, which each worker gets once and keeps.
        tasks: what it is called with.
        workers: number of processes.

    Yields:
        a task, and its result, or None if it killed its process.
    """
    if min(workers, len(tasks)) <= 1:
        for task in tasks:
            yield task, work(task)
        return
    waiting = deque(tasks)
    while waiting:
        suspects: list[Task] = []
        yield from _together(work, waiting, min(workers, len(waiting)), suspects)
        # One of them killed its process and spoilt the others' as well; alone it is known which.
        for task in suspects:
            yield from _alone(work, task)


def _together(
    work: Callable[[Task], Result], waiting: deque[Task], workers: int, suspects: list[Task]
) -> Iterator[tuple[Task, Result | None]]:
    """Results until all is done, or until a process dies: then what was at work becomes a suspect."""
    running: dict[Future[Result], Task] = {}
    pool = _pool(work, workers)
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                with unheard():
                    running[pool.submit(_do, waiting[0])] = waiting[0]
                waiting.popleft()
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield running.pop(future), future.result()
            if done & running.keys():
                raise BrokenProcessPool
    except BrokenProcessPool:
        suspects += running.values()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _alone(work: Callable[[Task], Result], task: Task) -> Iterator[tuple[Task, Result | None]]:
    with _pool(work, 1) as pool:
        try:
            with unheard():
                future = pool.submit(_do, task)
            result = future.result()
        except BrokenProcessPool:
            result = None
    yield task, result


def _pool(work: Callable[[Any], Any], workers: int) -> ProcessPoolExecutor:
    # Never a plain fork: the caller may have started threads.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start, initargs=(work,))


def _start(work: Callable[[Any], Any]) -> None:
    global _work
    start_worker()
    _work = work


def _do(task: Any) -> Any:  # noqa: ANN401
    return _work(task) if _work is not None else None
