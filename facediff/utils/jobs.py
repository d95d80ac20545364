"""The one way to run many independent tasks: in processes, in threads, one after the other, or on a Dask cluster.

Where tasks run changes nothing but the time that they take; :mod:`facediff.utils.cluster` has the part of the cluster.
"""

from __future__ import annotations

import ctypes
import importlib.util
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Collection, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ProcessPoolExecutor, ThreadPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, nullcontext
from functools import partial
from multiprocessing import resource_tracker
from multiprocessing.connection import wait as wait_for_end
from pathlib import Path
from typing import Any, Generic, Literal, TypeVar, cast, overload

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils.progress import progress_bar

Task = TypeVar("Task")
Result = TypeVar("Result")

Mode = Literal["processes", "threads", "serial"]
"""``processes`` for work in Python, ``threads`` for work that releases the interpreter's lock (torch, hashing)."""

LOCAL = ("processes", "threads", "serial")
ADDRESS = "DASK_SCHEDULER_ADDRESS"
"""Environment variable, also of Dask's own programs, with the cluster that is used where nothing else is asked for."""
SLURM = "slurm"
MOST_WORKERS = 4  # For each processor: more would take memory and no time off
GRACE = 10.0
"""Seconds that running tasks are given to come to their end when the work is stopped."""
THREAD_VARIABLES = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def processors() -> int:
    """Number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def check_scheduler(scheduler: str | None) -> str:
    """Where tasks run: one of :data:`LOCAL`, the address of a Dask scheduler, ``slurm`` with options, or "" for here.

    Args:
        scheduler: as ``--scheduler`` takes it; if None, what the environment variable :data:`ADDRESS` says.

    Raises:
        FaceDiffError: if it is none of these.
        MissingExtraError: if it is a cluster and Dask is not installed.

    Example:
        >>> check_scheduler("threads")
        'threads'
    """
    name = "--scheduler"
    if scheduler is None:
        name, scheduler = ADDRESS, os.environ.get(ADDRESS, "")
        if not scheduler:
            return ""
    kind, _, host = scheduler.partition("://")
    if kind.partition(":")[0] == SLURM:
        package = "dask_jobqueue"
    elif kind in ("tcp", "tls", "ws", "wss", "inproc") and host:
        package = "distributed"
    elif scheduler in LOCAL and name != ADDRESS:
        return scheduler
    else:
        raise FaceDiffError(
            f"{name} {scheduler}: is no place for tasks; expected {', '.join(LOCAL)}, slurm, or the address of a Dask "
            f"scheduler such as tcp://HOST:8786"
        )
    if importlib.util.find_spec(package) is None:
        raise MissingExtraError(package, "cluster", f"{name} {scheduler}")
    return scheduler


def is_cluster(scheduler: str | None) -> bool:
    """Whether tasks run on a cluster rather than on this machine.

    Raises:
        FaceDiffError: as :func:`check_scheduler`.
    """
    return scheduler != "" and check_scheduler(scheduler) not in ("", *LOCAL)


class WorkerDied:
    """Takes the place of the result of a task that killed its worker process, for lack of memory as a rule."""


class SetupError(FaceDiffError):
    """The set-up of a worker failed, so that every task would fail for the same reason."""


_setting_up = threading.Lock()  # one thread after the other: libraries are not made to be imported by several


class PerWorker(Generic[Task, Result]):
    """Work that needs something loaded first, such as a model: it is loaded once in each worker.

    Args:
        setup: loads it, and returns the function that does a task; picklable.
    """

    def __init__(self, setup: Callable[[], Callable[[Task], Result]]) -> None:
        self.setup = setup
        self._here = threading.local()  # what is loaded need not be fit for two threads

    def __reduce__(self) -> tuple[type[PerWorker[Task, Result]], tuple[Callable[[], Callable[[Task], Result]]]]:
        """Pickling: nothing that one worker has loaded goes to another."""
        return type(self), (self.setup,)

    def __call__(self, task: Task) -> Result:
        """Do a task.

        Raises:
            SetupError: if the set-up failed in a way that the user can put right.
        """
        work = getattr(self._here, "work", None)
        if work is None:
            try:
                with _setting_up:
                    work = self._here.work = self.setup()
            except FaceDiffError as error:
                raise SetupError(str(error)) from error
        return cast(Callable[[Task], Result], work)(task)


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
    scheduler: str | None = "",
    writes: Path | None = None,
    reads: Iterable[Path] = (),
    progress: str = "",
) -> Generator[tuple[Task, Result | WorkerDied]]: ...


def run_tasks(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    workers: int | None = None,
    mode: Mode = "processes",
    scheduler: str | None = "",
    writes: Path | None = None,
    reads: Iterable[Path] = (),
    progress: str = "",
) -> Generator[tuple[Task, Any]]:
    """Do tasks in several workers, and yield each with its result as soon as it is done.

    No worker gets a task before it is free for it, and at most one result for each worker waits to be taken, so memory
    is bounded and a stop waits only for what is running. Wrap the generator in :func:`contextlib.closing`, so that it
    stops with the loop that takes the results: what is running then has some seconds to come to its end before it is
    stopped, and nothing else is begun. Workers ignore Ctrl-C; only this process reacts to it.

    Args:
        work: does a task. For processes and clusters: a picklable function or object, which each worker gets once and
            keeps, such as :class:`PerWorker`. A task may be done again if its worker is lost, so it writes its files
            whole or not at all.
        tasks: what it is called with.
        workers: number of workers; as many as processors, or as the cluster has, if None. One process is not worth
            starting: its tasks are done in this process.
        mode: what the workers are on this machine. Processes and threads compute on one processor each. Where processes
            cannot be started (programs read from standard input, scripts without a main guard), this process does the
            work.
        scheduler: where the tasks run, as the option ``--scheduler`` says: a mode that takes precedence over ``mode``,
            a cluster (see :func:`check_scheduler`), or None for what the environment says. Here, if empty.
        writes: folder that tasks write to; workers of a cluster must see it, which is checked.
        reads: files and folders that tasks read; likewise.
        progress: title of a progress bar; none if empty.

    Yields:
        task and result, in the order in which they are done. The result of a task that kills its process is
        :class:`WorkerDied`: what was running then is tried again, one at a time, so that no other is lost.

    Raises:
        Exception: the first one that ``work`` raises; tasks that have not been begun are dropped.
        FaceDiffError: if the cluster cannot be used, or is lost.

    Example:
        >>> dict(run_tasks(len, ["a", "bb"], mode="threads"))
        {'a': 1, 'bb': 2}
    """
    where = check_scheduler(scheduler) if scheduler != "" else ""
    count = min(workers or processors(), len(tasks), MOST_WORKERS * processors())
    if where in ("", *LOCAL):
        results = _results(work, tasks, count, cast(Mode, where or mode))
    else:
        from facediff.utils.cluster import run_on_cluster

        results = run_on_cluster(work, tasks, where, workers=workers, writes=writes, reads=reads)
    with progress_bar(progress, len(tasks), shown=bool(progress)) as step, closing(results):
        for pair in results:
            yield pair
            step()


def in_order(
    results: Iterable[tuple[Task, Result | WorkerDied]], tasks: Sequence[Task]
) -> Iterator[tuple[Task, Result]]:
    """Results in the order of the tasks, for sums whose last digit depends on it; tasks are hashable and different.

    Raises:
        FaceDiffError: if a task killed its worker.

    Example:
        >>> list(in_order([("b", 2), ("a", 1)], ["a", "b"]))
        [('a', 1), ('b', 2)]
    """
    early: dict[Task, Result] = {}
    waiting = deque(tasks)
    for task, result in results:
        if isinstance(result, WorkerDied):
            raise FaceDiffError(f"{task}: killed its process, perhaps for lack of memory; use fewer --workers")
        early[task] = result
        while waiting and waiting[0] in early:
            yield waiting[0], early.pop(waiting.popleft())


def _results(
    work: Callable[[Task], Result], tasks: Sequence[Task], workers: int, mode: Mode
) -> Generator[tuple[Task, Result | WorkerDied]]:
    if mode == "threads" and tasks:
        with one_thread_each():
            yield from _together(ThreadPoolExecutor(workers), partial(_in_thread, work), deque(tasks), workers, deque())
    elif mode == "serial" or workers <= 1 or not _can_start():
        for task in tasks:
            yield task, work(task)
    else:
        waiting = deque(tasks)
        while waiting:
            suspects: deque[Task] = deque()
            workers = min(workers, len(waiting))
            yield from _together(process_pool(work, workers), _do, waiting, workers, suspects)
            # One of these tasks killed its process and thereby the whole pool; one at a time it is known which.
            while suspects:
                guilty: deque[Task] = deque()
                yield from _together(process_pool(work, 1), _do, suspects, 1, guilty)
                yield from ((task, WorkerDied()) for task in guilty)


def _together(
    pool: Executor, work: Callable[[Task], Result], waiting: deque[Task], workers: int, suspects: deque[Task]
) -> Iterator[tuple[Task, Result]]:
    """Results until all tasks are done, or until a process dies: then what was running goes to ``suspects``."""
    running: dict[Future[Result], Task] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                with starting_processes() if isinstance(pool, ProcessPoolExecutor) else nullcontext():
                    running[pool.submit(work, waiting[0])] = waiting[0]
                waiting.popleft()
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            _raise_first_error(running, done)
            for future in done:
                if not isinstance(future.exception(), BrokenProcessPool):
                    yield running.pop(future), future.result()
            if done & running.keys():
                raise BrokenProcessPool
    except BrokenProcessPool:
        suspects += running.values()
    except (KeyboardInterrupt, SystemExit, GeneratorExit):
        end_soon(pool, running)
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _raise_first_error(running: Collection[Future[Any]], done: Collection[Future[Any]]) -> None:
    """Raise the error of the first task that failed, in the order of the tasks, and not of the quickest to fail."""
    for place, future in enumerate(running):
        if future in done and isinstance(future.exception(), Exception):
            wait(list(running)[: place + 1])
            for earlier in list(running)[: place + 1]:
                if not isinstance(earlier.exception(), BrokenProcessPool):
                    earlier.result()


_busy: set[int] = set()  # threads that are doing a task


def _in_thread(work: Callable[[Task], Result], task: Task) -> Result:
    me = threading.get_ident()
    _busy.add(me)
    try:
        return work(task)
    finally:
        _busy.discard(me)


def end_soon(pool: Executor, running: Collection[Future[Any]], grace: float = GRACE) -> None:
    """Let what is running come to its end for some seconds, then end the workers; Ctrl-C again ends them."""
    workers = list((getattr(pool, "_processes", None) or {}).values())
    threads = {thread.ident for thread in getattr(pool, "_threads", ())}
    pool.shutdown(wait=False, cancel_futures=True)
    try:
        wait(running, grace)
    finally:
        if any(not future.done() for future in running):
            for worker in workers:
                worker.terminate()  # what it has begun to write is removed
            for thread in threads & _busy:  # nothing else ends a thread; it goes on until its next line of Python
                ctypes.pythonapi.PyThreadState_SetAsyncExc(ctypes.c_ulong(thread), ctypes.py_object(SystemExit))
            wait(running, GRACE)
        for worker in workers:
            if any(not future.done() for future in running):
                worker.kill()


# Worker processes.

_work: Callable[[Any], Any] | None = None


def process_pool(work: Callable[[Any], Any] | None, workers: int) -> ProcessPoolExecutor:
    """Worker processes, to be started by :func:`starting_processes`."""
    # Never a plain fork: the caller may have started threads, those of torch for instance.
    context = multiprocessing.get_context("spawn")
    return ProcessPoolExecutor(workers, mp_context=context, initializer=_start_worker, initargs=(work,))


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
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
