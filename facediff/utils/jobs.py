"""The one way to run many independent tasks: in processes, in threads, one after the other, or on a Dask cluster.

Where tasks run changes nothing but the time that they take; :mod:`facediff.utils.cluster` has the part of the cluster.
"""

from __future__ import annotations

import importlib.util
import os
import threading
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils.progress import progress_bar
from facediff.utils.workers import LOCAL, Mode, processors, run_locally

Task = TypeVar("Task")
Result = TypeVar("Result")

ADDRESS = "DASK_SCHEDULER_ADDRESS"
"""Environment variable, also of Dask's own programs, with the cluster that is used where nothing else is asked for."""
MOST_WORKERS = 4
"""Workers for each processor: more would take memory and no time off."""


def check_scheduler(scheduler: str | None) -> str:
    """Where tasks run: one of :data:`LOCAL`, the address of a Dask scheduler, or "" for here.

    ``scheduler`` is as ``--scheduler`` takes it; None stands for the environment variable :data:`ADDRESS`.
    """
    name = "--scheduler"
    if scheduler is None:
        name, scheduler = ADDRESS, os.environ.get(ADDRESS, "")
        if not scheduler:
            return ""
    if scheduler in LOCAL and name != ADDRESS:
        return scheduler
    kind, _, host = scheduler.partition("://")
    if kind not in ("tcp", "tls", "ws", "wss", "inproc") or not host:
        raise FaceDiffError(
            f"{name} {scheduler}: is no place for tasks; expected {', '.join(LOCAL)}, or the address of a Dask "
            f"scheduler such as tcp://HOST:8786"
        )
    if importlib.util.find_spec("distributed") is None:
        raise MissingExtraError("distributed", "cluster", f"{name} {scheduler}")
    return scheduler


def is_cluster(scheduler: str | None) -> bool:
    """Whether tasks run on a cluster rather than on this machine."""
    return scheduler != "" and check_scheduler(scheduler) not in ("", *LOCAL)


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
        """Do a task."""
        work = getattr(self._here, "work", None)
        if work is None:
            try:
                with _setting_up:
                    work = self._here.work = self.setup()
            except FaceDiffError as error:
                raise SetupError(error.on_command_line) from error
        return cast(Callable[[Task], Result], work)(task)


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

    At most one result for each worker waits to be taken. Wrap the generator in :func:`contextlib.closing`: running
    tasks then have some seconds to come to their end when the loop ends. Only this process reacts to Ctrl-C.

    Args:
        work: does a task; picklable, such as :class:`PerWorker`, and may do it again if a worker is lost.
        tasks: its arguments.
        workers: number of workers; as many as processors, or as the cluster has, if None. One works in this process.
        mode: kind of workers on this machine, each on one processor. Where processes cannot be started (programs read
            from standard input, scripts without a main guard), this process does the work.
        scheduler: a mode that takes precedence over ``mode``, or a cluster; see :func:`check_scheduler`.
        writes: folder that tasks write to; workers of a cluster must see it, which is checked.
        reads: files and folders that tasks read; likewise.
        progress: title of a progress bar; none if empty.

    Yields:
        task and result. The result of a task that kills its process is
        :class:`~facediff.utils.workers.WorkerDied`: tasks that were running then are tried again, one at a time, so
        that no other is lost.
    """
    where = check_scheduler(scheduler) if scheduler != "" else ""
    count = min(workers or processors(), len(tasks), MOST_WORKERS * processors())
    if where in ("", *LOCAL):
        results = run_locally(work, tasks, count, cast(Mode, where or mode))
    else:
        from facediff.utils.cluster import run_on_cluster

        results = run_on_cluster(work, tasks, where, workers=workers, writes=writes, reads=reads)
    with progress_bar(progress, len(tasks), shown=bool(progress)) as step, closing(results):
        for pair in results:
            yield pair
            step()
