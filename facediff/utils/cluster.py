"""Tasks on a Dask cluster, for :func:`facediff.utils.jobs.run_tasks`: its client and its workers.

Dask runs anything that its clients send: a connection to a scheduler can run programs as the user of its workers. Use
one that only its users reach, or TLS (``docs/cluster.md``).
"""

from __future__ import annotations

import asyncio
import importlib
import os
import pickle  # noqa: S403 - what a run sends its own workers, over the connection that Dask itself sends pickles by
import platform
import queue
import secrets
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from facediff.errors import FaceDiffError, damaged
from facediff.utils.files import scratch_folder
from facediff.utils.limits import brief
from facediff.utils.workers import GRACE, WorkerDied, one_thread_each
from facediff.version import __version__

Task = TypeVar("Task")
Result = TypeVar("Result")

CONNECTING = 10.0
"""Seconds that a scheduler has to answer."""
PATIENCE = 60.0
"""Seconds that a cluster may be without any worker before the work is given up; workers that restart take a few."""
LOST = "the scheduler was lost; start it again, and run the same command again, which continues"
SAME = "install the same packages on all machines, and start the workers again"


@dataclass(frozen=True)
class ClusterRun:
    """What workers must know of a run; the same for all of its tasks."""

    name: str  # unique
    folder: str  # the client's working folder, in which tasks run, so that relative names mean the same
    search: tuple[str, ...]  # folders that modules are imported from
    environment: Mapping[str, str]  # facediff's own variables
    files: Mapping[str, object]  # what a worker must find, by path; see :func:`fingerprint`
    work: bytes  # what does a task
    version: str = __version__
    python: str = platform.python_version().rpartition(".")[0]


def fingerprint(path: str) -> int | None:
    """A file's size, 0 of a folder: by it, another machine finds out whether it sees the same."""
    if os.path.isdir(path):
        return 0
    return os.path.getsize(path) if os.path.isfile(path) else None


# The client.


def run_on_cluster(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    scheduler: str,
    *,
    workers: int | None = None,
    writes: Path | None = None,
    reads: Iterable[Path] = (),
) -> Generator[tuple[Task, Result | WorkerDied]]:
    """Do tasks on a cluster; arguments, results and errors are as for :func:`facediff.utils.jobs.run_tasks`."""
    if not tasks:
        return
    import cloudpickle

    with ExitStack() as stack:
        client = stack.enter_context(connected(scheduler))
        files: dict[str, object] = {str(path.absolute()): fingerprint(str(path)) for path in reads}
        if writes is not None:
            files |= stack.enter_context(token(writes))
        facts = (os.getcwd(), search_path(), own_environment(), files)
        run = ClusterRun(secrets.token_hex(8), *facts, cloudpickle.dumps(work))
        try:
            yield from results_of(client, run, tasks, scheduler, workers or sys.maxsize)
        except (OSError, TimeoutError, asyncio.CancelledError) as error:
            if client.status == "running":
                raise
            raise FaceDiffError(f"--scheduler {scheduler}: {LOST}") from error


def results_of(
    client: Any,  # noqa: ANN401 - Dask has no types
    run: ClusterRun,
    tasks: Sequence[Task],
    scheduler: str,
    limit: int,
) -> Generator[tuple[Task, Any]]:
    """Tasks with their results; no worker gets a second task before it is free."""
    import cloudpickle

    refuse_unfit(client, run, scheduler)
    shared = client.submit(ClusterRun, **vars(run), pure=False)  # goes to each worker once
    pending, running = deque(tasks), dict[Any, tuple[Task, str]]()
    completed: queue.SimpleQueue[Any] = queue.SimpleQueue()
    last_worker = time.monotonic()
    try:
        while pending or running:
            addresses = list(client.nthreads())
            last_worker = time.monotonic() if addresses else last_worker
            if time.monotonic() - last_worker > PATIENCE:
                raise FaceDiffError(
                    f"--scheduler {scheduler}: has had no worker for {PATIENCE:.0f} s; start some with "
                    f"`dask worker {scheduler}`, and run the same command again"
                )
            occupied = {address for _, address in running.values()}
            for address in [address for address in addresses if address not in occupied][: limit - len(running)]:
                if pending:
                    task = pending.popleft()
                    options = {"workers": [address], "allow_other_workers": True, "pure": False}
                    future = client.submit(do_task, shared, cloudpickle.dumps(task), **options)
                    future.add_done_callback(completed.put)
                    running[future] = task, address
            with suppress(queue.Empty):
                future = completed.get(timeout=1.0)
                task, _ = running.pop(future)
                yield task, outcome(future, scheduler)
    finally:
        if running:
            stop(client, running, completed)


def outcome(future: Any, scheduler: str) -> Any:  # noqa: ANN401
    """The result of a task, or its error."""
    from distributed import KilledWorker

    if future.status not in ("finished", "error"):
        raise FaceDiffError(f"--scheduler {scheduler}: {LOST}")
    error = future.exception()
    if isinstance(error, KilledWorker):
        return WorkerDied()
    if error is not None:
        raise error
    return future.result()


def stop(client: Any, running: Mapping[Any, Any], completed: queue.SimpleQueue[Any]) -> None:  # noqa: ANN401
    """Let running tasks come to their end for some seconds, then start their workers again."""
    left, end = {future.key for future in running}, time.monotonic() + GRACE
    with suppress(queue.Empty):
        while left and (seconds := end - time.monotonic()) > 0:
            left.discard(completed.get(timeout=seconds).key)
    with suppress(Exception):  # a scheduler that is gone has nothing to end; workers without a nanny finish their tasks
        occupied = [address for address, keys in client.processing().items() if left & set(keys)]
        client.cancel(list(running))
        if occupied:
            client.restart_workers(occupied, timeout=GRACE)


def refuse_unfit(client: Any, run: ClusterRun, scheduler: str) -> None:  # noqa: ANN401
    """Refuse workers that cannot take part in a run."""
    for address, answer in client.run(problem, run, on_error="return").items():
        if isinstance(answer, BaseException):
            answer = f"has no facediff {__version__} ({brief(answer.__cause__ or answer)}); {SAME}"  # noqa: PLW2901
        if answer:
            raise FaceDiffError(f"worker {address} of --scheduler {scheduler} {answer}")


@contextmanager
def token(folder: Path) -> Iterator[dict[str, object]]:
    """A file in a folder that workers must see, for as long as the block runs."""
    with scratch_folder(folder / "cluster") as scratch:
        file = scratch / "token"
        # Its length says which one it is: two folders on two machines may have the same name.
        file.write_bytes(bytes(1 + secrets.randbelow(4096)))
        yield {str(file.absolute()): fingerprint(str(file))}


def search_path() -> tuple[str, ...]:
    """Folders of the user's own from which this process imports modules, such as the working folder."""
    installed = {os.path.realpath(prefix) for prefix in (sys.prefix, sys.base_prefix)}
    absolute = [os.path.realpath(entry or os.getcwd()) for entry in sys.path]
    entries = [entry for entry in absolute if not any(entry.startswith(prefix + os.sep) for prefix in installed)]
    return tuple(dict.fromkeys(entries))


def own_environment() -> dict[str, str]:
    """Variables that change what facediff does, such as the folder of its cache."""
    return {name: value for name, value in os.environ.items() if name.startswith("FACEDIFF_")}


@contextmanager
def connected(scheduler: str) -> Iterator[Any]:
    """A client of the scheduler."""
    import distributed

    source = f"--scheduler {scheduler}: no Dask scheduler answers there within {CONNECTING:.0f} s"
    remedy = "start one with `dask scheduler`, or give the address that it prints"
    with damaged(source, remedy, OSError, RuntimeError, ImportError), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of other versions of packages
        client = distributed.Client(scheduler, timeout=CONNECTING, set_as_default=False, name="facediff")
    try:
        yield client
    finally:
        with suppress(Exception):  # a lost scheduler cannot be told
            client.close(timeout=2)


# The workers. Everything below runs in the processes of the cluster.

_turn = threading.Lock()  # a worker does one task at a time, whoever asks, however many threads it has
_taken_up: tuple[str, Callable[[Any], Any]] | None = None


def problem(run: ClusterRun) -> str:
    """Why this worker cannot take part in a run, else an empty text."""
    python = platform.python_version().rpartition(".")[0]
    if run.version != __version__:
        return f"has facediff {__version__}, and this is facediff {run.version}; {SAME}"
    if run.python != python:
        return f"runs Python {python}, and this is Python {run.python}; {SAME}"
    if not os.path.isdir(run.folder):
        return f"does not see the folder {run.folder}; run on storage that all machines share"
    for path, expected in run.files.items():
        if fingerprint(path) != expected:
            folder = os.path.dirname(os.path.dirname(path)) if path.endswith(f"{os.sep}token") else path
            return f"does not see the same {folder}; use storage that all machines share, under one name"
    return ""


def take_up(run: ClusterRun) -> Callable[[Any], Any]:
    """Make a run this worker's; what does its tasks."""
    global _taken_up
    if _taken_up is None or _taken_up[0] != run.name:
        if unfit := problem(run):
            raise FaceDiffError(f"a worker {unfit}")
        os.chdir(run.folder)
        for name in own_environment():
            del os.environ[name]
        os.environ.update(run.environment)
        sys.path += [entry for entry in run.search if entry not in sys.path]
        importlib.invalidate_caches()
        _taken_up = run.name, pickle.loads(run.work)  # noqa: S301 - see the top of the file
    return _taken_up[1]


def do_task(run: ClusterRun, task: bytes) -> Any:  # noqa: ANN401
    """Do a task of a run in this worker."""
    with _turn:
        work = take_up(run)
        with one_thread_each():
            return work(pickle.loads(task))  # noqa: S301
