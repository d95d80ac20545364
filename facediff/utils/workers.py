"""Worker processes and threads of this machine: how they start, do tasks one by one, and end.

The rest of the package calls :func:`facediff.utils.jobs.run_tasks`.
"""

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
from typing import Any, Literal, TypeVar

Task = TypeVar("Task")
Result = TypeVar("Result")

Mode = Literal["processes", "threads", "serial"]
"""``processes`` for work in Python, ``threads`` for work that releases the interpreter's lock (torch, hashing)."""

LOCAL = ("processes", "threads", "serial")
GRACE = 10.0
"""Seconds that running tasks are given to come to their end when the work is stopped."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class WorkerDied:
    """Takes the place of the result of a task that killed its worker process, for lack of memory as a rule."""


def run_locally(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int, mode: Mode
) -> Generator[tuple[Task, Result | WorkerDied]]:
    """Do tasks on this machine, for :func:`facediff.utils.jobs.run_tasks`."""
    if mode == "threads" and tasks:
        with one_thread_each():
            yield from _together(ThreadPoolExecutor(workers), work, deque(tasks), workers, deque())
    elif mode == "serial" or workers <= 1 or not _can_start():
        for task in tasks:
            yield task, work(task)
    else:
        queue = deque(tasks)
        while queue:
            suspects: deque[Task] = deque()
            workers = min(workers, len(queue))
            yield from _together(process_pool(work, workers), _do, queue, workers, suspects)
            # One of these tasks killed its process and thereby the whole pool; one at a time it is known which.
            while suspects:
                guilty: deque[Task] = deque()
                yield from _together(process_pool(work, 1), _do, suspects, 1, guilty)
                yield from ((task, WorkerDied()) for task in guilty)


def _together(
    pool: Executor, work: Callable[[Task], Result], queue: deque[Task], workers: int, suspects: deque[Task]
) -> Iterator[tuple[Task, Result]]:
    """Results until all tasks are done, or until a process dies: then running tasks go to ``suspects``."""
    running: dict[Future[Result], Task] = {}
    try:
        while queue or running:
            while queue and len(running) < workers:
                with starting_processes() if isinstance(pool, ProcessPoolExecutor) else nullcontext():
                    running[pool.submit(work, queue[0])] = queue[0]
                queue.popleft()
            complete, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in complete:
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield running.pop(future), future.result()
            if complete & running.keys():
                raise BrokenProcessPool
    except BrokenProcessPool:
        suspects += running.values()
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        end_soon(pool, running)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def end_soon(pool: Executor, running: Collection[Future[Any]]) -> None:
    """Let running tasks come to their end for some seconds, then end the processes; Ctrl-C again ends them."""
    processes = list((getattr(pool, "_processes", None) or {}).values())
    pool.shutdown(wait=False, cancel_futures=True)
    try:
        wait(running, GRACE)
    finally:
        if any(not future.done() for future in running):
            for process in processes:
                process.terminate()  # what it has begun to write is removed
            wait(running, GRACE)
        for process in processes:
            if any(not future.done() for future in running):
                process.kill()


# Worker processes.

_work: Callable[[Any], Any] | None = None


def process_pool(work: Callable[[Any], Any] | None, workers: int) -> ProcessPoolExecutor:
    """Worker processes, to be started by :func:`starting_processes`."""
    # Never a plain fork: the caller may have started threads, such as torch's.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(work,))


def in_own_process(work: Callable[[Task], Result], task: Task) -> Result | WorkerDied:
    """Do one task in a process that does nothing else, so that memory and crashes are its own.

    Where processes cannot be started, this process does it.
    """
    if not _can_start():
        return work(task)
    suspects: deque[Task] = deque()
    for _, result in _together(process_pool(work, 1), _do, deque([task]), 1, suspects):
        return result
    return WorkerDied()


def _can_start() -> bool:
    """Whether processes start at all; found out without work, since handing much to one that dies would block."""
    with process_pool(None, 1) as pool:
        try:
            with starting_processes():
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
def starting_processes() -> Iterator[None]:
    """Processes that are started inside compute on one thread each and ignore Ctrl-C, even while they start.

    A worker that Ctrl-C ended would break the pool in the middle of the others' work; this process receives the signal
    afterwards. The libraries read the number of threads when they are imported, which is before a worker's first task.
    """
    mask = None
    if hasattr(signal, "pthread_sigmask"):
        resource_tracker.ensure_running()  # if it started later, it would undo the mask
        mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        with _one_thread_variables():
            yield
    finally:
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _one_thread_variables() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in THREAD_VARIABLES}
    os.environ.update(dict.fromkeys(THREAD_VARIABLES, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextmanager
def one_thread_each() -> Iterator[None]:
    """Threads inside compute on one thread each; digits then do not depend on the machine."""
    torch: Any = sys.modules.get("torch")
    if torch is None:  # a task may import it
        with _one_thread_variables():
            yield
        return
    with torch_threads(1):
        yield


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """PyTorch, which is imported already, computes on so many threads."""
    torch: Any = sys.modules["torch"]
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
