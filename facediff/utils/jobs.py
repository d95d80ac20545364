"""The one way to run many independent tasks: in processes, in threads or one after the other."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, nullcontext
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for_end
from typing import Any, Generic, Literal, TypeVar, overload

from facediff.errors import FaceDiffError
from facediff.utils.progress import progress_bar

Task = TypeVar("Task")
Result = TypeVar("Result")

Mode = Literal["processes", "threads", "serial"]
"""``processes`` for work in Python, ``threads`` for work that releases the interpreter's lock (torch, hashing)."""

MOST_WORKERS = 4  # For each processor: more would take memory and no time off
GRACE = 10.0
"""Seconds that running tasks are given to come to their end when the work is stopped."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerDied:
    """Takes the place of the result of a task that killed its worker process, for lack of memory as a rule."""


class SetupError(FaceDiffError):
    """The set-up of a worker failed, so that every task would fail for the same reason."""


class PerWorker(Generic[Task, Result]):
    """Work that needs something loaded first, such as a model: it is loaded once in each worker.

    Args:
        setup: loads it, and returns the function that does a task; picklable.
    """

    def __init__(self, setup: Callable[[], Callable[[Task], Result]]) -> None:
        self.setup = setup
        self._work: Callable[[Task], Result] | None = None

    def __call__(self, task: Task) -> Result:
        """Do a task.

        Raises:
            SetupError: if the set-up failed in a way that the user can put right.
        """
        if self._work is None:
            try:
                self._work = self.setup()
            except FaceDiffError as error:
                raise SetupError(str(error)) from error
        return self._work(task)


@overload
def run_tasks(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    mode: Literal["threads", "serial"],
    progress: str = "",
) -> Generator[tuple[Task, Result]]: ...


@overload
def run_tasks(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    mode: Mode = "processes",
    progress: str = "",
) -> Generator[tuple[Task, Result | WorkerDied]]: ...


def run_tasks(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    mode: Mode = "processes",
    progress: str = "",
) -> Generator[tuple[Task, Any]]:
    """Do tasks in several workers, and yield each with its result as soon as it is done.

    No worker gets a task before it is free for it, and at most one result for each worker waits to be taken, so memory
    is bounded and a stop waits only for what is running. Wrap the generator in :func:`contextlib.closing`, so that it
    stops with the loop that takes the results: what is running then has some seconds to come to its end before its
    process is stopped, and nothing else is begun. Workers ignore Ctrl-C; only this process reacts to it.

    Args:
        work: does a task. For processes: a picklable function or object, which each worker gets once and keeps, such as
            :class:`PerWorker`.
        tasks: what it is called with.
        workers: number of workers; as many as processors if None. One process is not worth starting: its tasks are
            done in this process.
        mode: what the workers are. Processes and threads compute on one processor each. Where processes cannot be
            started (programs read from standard input, scripts without a main guard), this process does the work.
        progress: title of a progress bar; none if empty.

    Yields:
        task and result, in the order in which they are done. The result of a task that kills its process is
        :class:`WorkerDied`: what was running then is tried again, one at a time, so that no other is lost.

    Raises:
        Exception: the first one that ``work`` raises; tasks that have not been begun are dropped.

    Example:
        >>> dict(run_tasks(len, ["a", "bb"], mode="threads"))
        {'a': 1, 'bb': 2}
    """
    count = min(workers or processors(), len(tasks), MOST_WORKERS * processors())
    with progress_bar(progress, len(tasks), shown=bool(progress)) as step:
        for pair in _results(work, tasks, count, mode):
            yield pair
            step()


def _results(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int, mode: Mode
) -> Generator[tuple[Task, Result | WorkerDied]]:
    if mode == "threads" and tasks:
        with one_thread_each():
            yield from _together(ThreadPoolExecutor(workers), work, deque(tasks), workers, deque())
    elif mode == "serial" or workers <= 1 or not _can_start():
        for task in tasks:
            yield task, work(task)
    else:
        waiting = deque(tasks)
        while waiting:
            suspects: deque[Task] = deque()
            workers = min(workers, len(waiting))
            yield from _together(_pool(work, workers), _do, waiting, workers, suspects)
            # One of these tasks killed its process and thereby the whole pool; one at a time it is known which.
            while suspects:
                guilty: deque[Task] = deque()
                yield from _together(_pool(work, 1), _do, suspects, 1, guilty)
                yield from ((task, WorkerDied()) for task in guilty)


def _together(
    pool: Executor, work: Callable[[Task], Result], waiting: deque[Task], workers: int, suspects: deque[Task]
) -> Iterator[tuple[Task, Result]]:
    """Results until all tasks are done, or until a process dies: then what was running goes to ``suspects``."""
    running: dict[Future[Result], Task] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                with _starting_processes() if isinstance(pool, ProcessPoolExecutor) else nullcontext():
                    running[pool.submit(work, waiting[0])] = waiting[0]
                waiting.popleft()
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield running.pop(future), future.result()
            if done & running.keys():
                raise BrokenProcessPool
    except BrokenProcessPool:
        suspects += running.values()
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        _end_soon(pool, running)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _end_soon(pool: Executor, running: Collection[Future[Any]]) -> None:
    """Let what is running come to its end for some seconds, then end the worker processes; Ctrl-C again ends them."""
    workers = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    try:
        wait(running, GRACE)
    finally:
        if any(not future.done() for future in running):
            for worker in workers:
                worker.terminate()  # what it has begun to write is removed
            wait(running, GRACE if workers else 0)
        for worker in workers:
            if any(not future.done() for future in running):
                worker.kill()


# Worker processes.

_work: Callable[[Any], Any] | None = None


def _pool(work: Callable[[Any], Any] | None, workers: int) -> ProcessPoolExecutor:
    # Never a plain fork: the caller may have started threads, those of torch for instance.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(work,))


def _can_start() -> bool:
    """Whether processes start at all; found out without work, since handing much to one that dies would block."""
    with _pool(None, 1) as pool:
        try:
            with _starting_processes():
                return pool.submit(os.getpid).result() != os.getpid()
        except BrokenProcessPool:
            return False


def _start_worker(work: Callable[[Any], Any] | None) -> None:
    global _work
    _work = work
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _stop_task)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent.sentinel,), daemon=True).start()


def _stop_task(number: int, _frame: object) -> None:
    signal.signal(number, signal.SIG_DFL)
    raise SystemExit(128 + number)  # so that a half-written file is removed on the way out


def _end_with(sentinel: int) -> None:
    """End this worker when its parent ends, however that ends."""
    wait_for_end([sentinel])
    os._exit(1)


def _do(task: Any) -> Any:  # noqa: ANN401
    return _work(task) if _work is not None else None


@contextmanager
def _starting_processes() -> Iterator[None]:
    """Processes that are started inside compute on one thread each and ignore Ctrl-C, even while they start.

    A worker that Ctrl-C ended would break the pool in the middle of the others' work; this process receives the signal
    afterwards. The libraries read the number of threads when they are imported, which is before a worker's first task.
    """
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    mask = None
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # if it started later, it would undo the mask
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Threads inside compute on one thread each, where torch is loaded; digits then do not depend on the machine."""
    torch: Any = sys.modules.get("torch")
    if torch is None:
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
