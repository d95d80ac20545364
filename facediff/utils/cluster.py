"""Tasks on a Dask cluster, for :func:`facediff.utils.jobs.run_tasks`: the part of the client and that of the workers.

A worker of the cluster does no task itself. It starts a process in which tasks run, one at a time, as the processes of
a single machine do: in the client's working folder, with the model loaded once, on one processor, and ended with all
that it has begun when the client no longer wants the task or is gone. So a task that kills its process costs no worker,
and what a user sees is the same as without a cluster.

Dask runs whatever its clients send. Whoever can connect to a scheduler can run programs as the user of its workers; use
one that only its users reach, or TLS (``docs/cluster.md``).
"""

from __future__ import annotations

import asyncio
import atexit
import importlib
import logging
import multiprocessing
import os
import pickle  # noqa: S403 - what a run sends its own workers, over the connection that Dask itself sends pickles by
import platform
import queue
import re
import secrets
import shutil
import sys
import threading
import time
import warnings
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

from facediff.errors import FaceDiffError, choices
from facediff.utils import workers as local_workers
from facediff.utils.files import scratch_folder
from facediff.utils.workers import GRACE, SLURM, WorkerDied
from facediff.version import __version__

Task = TypeVar("Task")
Result = TypeVar("Result")

CONNECTING = 10.0
"""Seconds that a scheduler has to answer."""
PATIENCE = 60.0
"""Seconds that a cluster may be without any worker before the work is given up; workers that restart take a few."""
IDLE = 60.0
"""Seconds after which a worker ends a process that has nothing to do, since its client may have been killed."""
REFRESH = 0.5
"""Seconds after which the scheduler is asked again which workers it has."""
POLL = 0.2
"""Seconds between two looks at whether a task is still wanted."""
FEW = 20
"""Names of a folder that workers are asked for."""
LOGGERS = ("distributed", "distributed.client", "distributed.worker", "tornado.application", "asyncio")


@dataclass(frozen=True)
class ClusterRun:
    """What workers must know of a run; the same for all of its tasks."""

    name: str  # unique
    folder: str  # the client's working folder, in which tasks run, so that relative names mean the same
    search: tuple[str, ...]  # folders that modules are imported from
    environment: Mapping[str, str]  # facediff's own variables
    seen: Mapping[str, object]  # what a worker must find, by path; see :func:`look`
    work: bytes  # what does a task
    version: str = __version__
    python: str = platform.python_version().rpartition(".")[0]


def look(path: str) -> int | tuple[str, ...] | None:
    """What is at a path, by which another machine finds out whether it sees the same.

    Returns:
        a file's size, a few names out of a folder, which may get more meanwhile, or None if there is nothing.
    """
    try:
        if not os.path.isdir(path):
            return os.stat(path).st_size
        names = sorted(name for name in os.listdir(path) if not name.startswith("."))
        return tuple(names[:: max(1, len(names) // FEW)])
    except OSError:
        return None


def sees(path: str, facts: object) -> bool:
    """Whether what :func:`look` has found on another machine is here as well."""
    if isinstance(facts, tuple):
        return os.path.isdir(path) and all(os.path.lexists(os.path.join(path, name)) for name in facts)
    return look(path) == facts


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
    """Do tasks on a cluster; arguments, results and errors are those of :func:`facediff.utils.jobs.run_tasks`.

    Args:
        work: does a task.
        tasks: what it is called with.
        scheduler: address of a Dask scheduler, or ``slurm`` with options.
        workers: workers that are used at a time; all if None. With SLURM, how many are asked for.
        writes: folder that tasks write to.
        reads: what they read.

    Raises:
        FaceDiffError: if the scheduler does not answer, a worker does not see the same files or has another version of
            facediff, or the cluster is lost.
    """
    if not tasks:
        return
    import cloudpickle

    with ExitStack() as stack:
        stack.enter_context(quiet())
        client = stack.enter_context(connected(scheduler, workers, len(tasks)))
        seen: dict[str, object] = {str(path.absolute()): look(str(path)) for path in reads}
        if writes is not None:
            seen |= stack.enter_context(token(writes))
        name = f"facediff-{secrets.token_hex(8)}"
        facts = (name, os.getcwd(), search_path(), own_environment(), seen)
        cluster = Cluster(client, scheduler, ClusterRun(*facts, cloudpickle.dumps(work)), workers)
        stack.callback(cluster.leave)
        yield from cluster.results(tasks)


@contextmanager
def token(folder: Path) -> Iterator[dict[str, object]]:
    """A file in a folder that workers must see, for as long as the block runs."""
    with scratch_folder(folder / "cluster") as scratch:
        file = scratch / "token"
        # Its length says which one it is: two folders on two machines may have the same name.
        file.write_bytes(bytes(1 + secrets.randbelow(4096)))
        yield {str(file.absolute()): look(str(file))}


def search_path() -> tuple[str, ...]:
    """Folders of the user's own from which this process imports modules, such as the working folder."""
    installed = {os.path.realpath(prefix) for prefix in (sys.prefix, sys.base_prefix)}
    absolute = [os.path.realpath(entry or os.getcwd()) for entry in sys.path]
    own = [entry for entry in absolute if not any(entry.startswith(prefix + os.sep) for prefix in installed)]
    return tuple(dict.fromkeys(own))


def own_environment() -> dict[str, str]:
    """Variables that change what facediff does, such as the folder of its cache."""
    return {name: value for name, value in os.environ.items() if name.startswith("FACEDIFF_")}


@contextmanager
def quiet() -> Iterator[None]:
    """Keep Dask from logging what is reported as an error here."""
    import distributed  # noqa: F401 - which chooses levels of its own when it is imported

    loggers = [logging.getLogger(name) for name in LOGGERS]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextmanager
def connected(scheduler: str, workers: int | None, tasks: int) -> Iterator[Any]:
    """A client of the scheduler.

    Raises:
        FaceDiffError: if it does not answer.
    """
    import distributed

    where: Any = slurm_cluster(scheduler, workers, tasks) if scheduler.partition(":")[0] == SLURM else scheduler
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of other versions of packages, of which :func:`meet` refuses what matters
            client = distributed.Client(where, timeout=CONNECTING, set_as_default=False, name="facediff")
    except (OSError, TimeoutError, ValueError, TypeError, RuntimeError, ImportError) as error:
        raise FaceDiffError(
            f"--scheduler {scheduler}: no Dask scheduler answers there within {CONNECTING:.0f} s "
            f"({reason(error)}); start one with `dask scheduler`, or give the address that it prints"
        ) from error
    try:
        yield client
    finally:
        with suppress(Exception):  # a lost scheduler cannot be told
            client.close(timeout=2)


def reason(error: BaseException) -> str:
    """What an error of Dask's says, in a few words."""
    text = re.sub(r"in <.*?>: ", "", " ".join(str(error.__cause__ or error).split())) or type(error).__name__
    text = text.partition("stderr: ")[2] or text  # of a program that failed
    return text if len(text) <= 120 else f"{text[:120]}…"


class Cluster:
    """One run on a cluster.

    Args:
        client: connected to the scheduler.
        scheduler: as the user named it.
        run: what workers must know.
        most: workers that are used at a time; all if None.
    """

    def __init__(self, client: Any, scheduler: str, run: ClusterRun, most: int | None) -> None:  # noqa: ANN401
        self.client, self.scheduler, self.run = client, scheduler, run
        self.most = most or sys.maxsize
        self.known: tuple[float, list[str]] = 0.0, []  # when the workers were last asked for, and which there were
        self.met: set[str] = set()  # workers that have been told of the run, and see what they must
        self.done: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def results(self, tasks: Sequence[Task]) -> Generator[tuple[Task, Any]]:
        """Tasks with their results, as they are done; no worker gets a second task before it is free."""
        waiting = deque(enumerate(tasks))
        running: dict[Any, tuple[int, Task, str]] = {}
        alone_since: float | None = None
        try:
            while waiting or running:
                workers = self.workers()
                alone_since = self.check_patience(alone_since, workers)
                busy = {worker for _, _, worker in running.values()}
                for worker in [worker for worker in workers if worker not in busy]:
                    if waiting and len(running) < self.most:
                        number, task = waiting.popleft()
                        running[self.submit(number, task, worker)] = number, task, worker
                with suppress(queue.Empty):
                    future = self.done.get(timeout=1.0)
                    number, task, _ = running.pop(future)
                    state, value = self.outcome(future)
                    if state == "unknown":  # a worker that joined later, or took the task of one that was lost
                        waiting.appendleft((number, task))
                        self.met.discard(value.decode())
                    else:
                        yield task, value
        except (KeyboardInterrupt, SystemExit, GeneratorExit):
            self.stop(running)
            raise

    def submit(self, number: int, task: object, worker: str) -> Any:  # noqa: ANN401
        """Send a task to a worker; if that is lost, Dask runs it on another one."""
        import cloudpickle

        future = self.client.submit(
            do_task,
            self.run.name,
            cloudpickle.dumps(task),
            key=f"{self.run.name}-{number}-{secrets.token_hex(4)}",
            workers=[worker],
            allow_other_workers=True,
            pure=False,
        )
        future.add_done_callback(self.done.put)
        return future

    def outcome(self, future: Any) -> tuple[str, Any]:  # noqa: ANN401
        """What became of a task.

        Raises:
            Exception: the one that the task raised.
            FaceDiffError: if a worker cannot do it, or the scheduler has forgotten it.
        """
        from distributed.scheduler import KilledWorker

        if future.status not in ("finished", "error"):
            raise FaceDiffError(f"--scheduler {self.scheduler}: {LOST}")
        error = future.exception()
        if isinstance(error, KilledWorker):
            return "died", WorkerDied()
        if error is not None:
            raise FaceDiffError(f"--scheduler {self.scheduler}: a worker cannot do a task ({reason(error)}); {SAME}")
        state, value = future.result()
        if state == "unknown":
            return state, value
        if state == "refused":
            raise FaceDiffError(value.decode())
        if state == "died":
            return state, WorkerDied()
        raised, result = pickle.loads(value)  # noqa: S301 - see the top of the file
        if raised:
            raise result
        return state, result

    def workers(self) -> list[str]:
        """Addresses of the workers that there are now; new ones are told of the run first.

        Raises:
            FaceDiffError: if the scheduler is gone, or a worker cannot take part.
        """
        asked, addresses = self.known
        if time.monotonic() - asked < REFRESH and self.met.issuperset(addresses):
            return addresses
        try:
            addresses = list(self.client.nthreads())
            new = [worker for worker in addresses if worker not in self.met]
            answers = self.client.run(meet, self.run, workers=new, on_error="return") if new else {}
        except (OSError, TimeoutError, ValueError, RuntimeError, asyncio.CancelledError) as error:
            raise FaceDiffError(f"--scheduler {self.scheduler}: {LOST}") from error
        for worker, answer in answers.items():
            if isinstance(answer, OSError | TimeoutError):  # just gone
                addresses.remove(worker)
                continue
            if isinstance(answer, BaseException):
                answer = f"has no facediff {__version__} ({reason(answer)}); {SAME}"
            if answer:
                raise FaceDiffError(f"worker {worker} of --scheduler {self.scheduler} {answer}")
            self.met.add(worker)
        self.known = time.monotonic(), addresses
        return addresses

    def check_patience(self, alone_since: float | None, workers: Sequence[str]) -> float | None:
        """Since when there has been no worker.

        Raises:
            FaceDiffError: if that is too long ago; SLURM may let them wait for hours.
        """
        now = time.monotonic()
        if workers:
            return None
        if self.scheduler.partition(":")[0] == SLURM:
            if alone_since is None:
                print("facediff: waiting for SLURM to start workers", file=sys.stderr, flush=True)
        elif alone_since is not None and now - alone_since > PATIENCE:
            raise FaceDiffError(
                f"--scheduler {self.scheduler}: has had no worker for {PATIENCE:.0f} s; start some with "
                f"`dask worker {self.scheduler}`, and run the same command again"
            )
        return now if alone_since is None else alone_since

    def stop(self, running: Mapping[Any, Any]) -> None:
        """Let what is running come to its end for some seconds, then let the workers end it."""
        end = time.monotonic() + GRACE
        left = set(running)
        with suppress(queue.Empty):
            while left and (rest := end - time.monotonic()) > 0:
                left.discard(self.done.get(timeout=rest))

    def leave(self) -> None:
        """Let the workers end what is still running and forget the run; returns when they have."""
        with suppress(Exception):  # a worker or a scheduler that is gone has nothing to end
            self.client.run(forget, self.run.name, on_error="ignore")


LOST = "the scheduler was lost; start it again, and run the same command again, which continues"
SAME = "install the same packages on all machines, and start the workers again"


# SLURM.

_clusters: dict[str, Any] = {}


def slurm_cluster(scheduler: str, workers: int | None, tasks: int) -> Any:  # noqa: ANN401
    """Jobs of SLURM that are workers, by dask-jobqueue; started once in a process, and cancelled when it ends.

    Args:
        scheduler: ``slurm``, or ``slurm:OPTION=VALUE,…`` with options of ``dask_jobqueue.SLURMCluster``; what is not
            given is read from Dask's own configuration (``~/.config/dask/jobqueue.yaml``).
        workers: how many; those of one job if None.
        tasks: no more are started than there are tasks.

    Raises:
        FaceDiffError: if SLURM is not here, or an option is wrong or missing.
    """
    cluster = _clusters.get(scheduler)
    if cluster is None:
        options = slurm_options(scheduler)
        if shutil.which("sbatch") is None:
            raise FaceDiffError(f"--scheduler {scheduler}: there is no program sbatch; run facediff where SLURM is")
        import dask_jobqueue

        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a dashboard at another port
                cluster = dask_jobqueue.SLURMCluster(**options)
                cluster.job_script()
        except (ValueError, TypeError, OSError, RuntimeError) as error:
            raise FaceDiffError(f"--scheduler {scheduler}: {reason(error)}; see docs/cluster.md") from error
        _clusters[scheduler] = cluster
        atexit.register(close_cluster, scheduler)
    per_job = cluster._dummy_job.worker_processes
    cluster.scale(n=max(per_job, min(workers or per_job, tasks)))
    try:
        check_jobs(cluster)
    except (OSError, RuntimeError) as error:
        close_cluster(scheduler)
        raise FaceDiffError(f"--scheduler {scheduler}: a job cannot be started ({reason(error)})") from error
    return cluster


def check_jobs(cluster: Any) -> None:  # noqa: ANN401
    """Wait until jobs are submitted, and submit those again that were refused, of which dask-jobqueue only logs why.

    Raises:
        OSError: if there is no such program, likewise.
        RuntimeError: with what ``sbatch`` said.
    """
    end = time.monotonic() + PATIENCE
    while not set(cluster.worker_spec) <= set(cluster.workers) and time.monotonic() < end:
        time.sleep(POLL / 4)
    for job in list(cluster.workers.values()):
        if job.status.name == "created":
            cluster.sync(job.start)


def close_cluster(scheduler: str) -> None:
    """Cancel the jobs of a cluster."""
    cluster = _clusters.pop(scheduler, None)
    if cluster is not None:
        # Jobs that were refused are not there to be cancelled, which dask-jobqueue would insist on.
        for name, job in list(cluster.workers.items()):
            if job.status.name == "created":
                cluster._created.discard(job)
                cluster.worker_spec.pop(name, None)
                cluster.workers.pop(name, None)
        with quiet(), suppress(Exception):
            cluster.close(timeout=5)


def slurm_options(scheduler: str) -> dict[str, Any]:
    """The options of ``slurm:cores=4,memory=16GB``; a value is read as YAML, so that ``[a, b]`` is a list.

    A worker does one task at a time on one processor, so a job has as many worker processes as cores unless
    ``processes`` says otherwise.
    """
    import inspect

    import dask
    import dask_jobqueue
    import yaml
    from dask_jobqueue.core import Job, JobQueueCluster
    from dask_jobqueue.slurm import SLURMJob

    names = {
        name
        for owner in (SLURMJob, Job, JobQueueCluster)
        for name in inspect.signature(owner.__init__).parameters
        if name not in ("self", "args", "kwargs", "job_kwargs", "job_cls", "loop", "asynchronous", "n_workers")
    }
    assert dask_jobqueue.SLURMCluster.job_cls is SLURMJob  # noqa: S101
    options: dict[str, Any] = {}
    for word in filter(None, re.split(r",(?![^\[]*\])", scheduler.partition(":")[2])):
        name, equals, value = word.partition("=")
        name = name.strip().replace("-", "_")
        if name not in names or not equals:
            raise FaceDiffError(f"--scheduler {scheduler}: there is no option {name!r}: {choices(name, sorted(names))}")
        # A walltime such as 01:30:00 is a number to YAML.
        try:
            options[name] = value if re.fullmatch(r"[\d:-]+:[\d:]+", value) else yaml.safe_load(value)
        except yaml.YAMLError as error:
            raise FaceDiffError(
                f"--scheduler {scheduler}: {name} is {value!r}; expected a number, a text, or a list such as [a, b]"
            ) from error
    configured = dask.config.get("jobqueue.slurm", {})
    if options.get("processes", configured.get("processes")) is None:
        options["processes"] = options.get("cores", configured.get("cores"))
    return options


# The workers. Everything below runs in the processes of the cluster.


def meet(run: ClusterRun, dask_worker: Any = None) -> str:  # noqa: ANN401 - Dask names its workers so
    """Take note of a run; why this worker cannot take part in it, else an empty text."""
    python = platform.python_version().rpartition(".")[0]
    if getattr(run, "version", "") != __version__:
        return f"has facediff {__version__}, and this is facediff {getattr(run, 'version', 'of another age')}; {SAME}"
    if run.python != python:
        return f"runs Python {python}, and this is Python {run.python}; {SAME}"
    if not os.path.isdir(run.folder):
        return f"does not see the folder {run.folder}; run on storage that all machines share"
    for path, facts in run.seen.items():
        if not sees(path, facts):
            what = os.path.dirname(os.path.dirname(path)) if path.endswith(f"{os.sep}token") else path
            return f"does not see the same {what}; use storage that all machines share, under one name"
    _hosts.setdefault((dask_worker.address, run.name), Host(run, _turns.setdefault(dask_worker.address, _Turn())))
    return ""


@dataclass
class _Turn:
    """Which run may do a task now: one process of a cluster is one worker, whoever asks."""

    lock: threading.Lock = field(default_factory=threading.Lock)


_hosts: dict[tuple[str, str], Host] = {}
_turns: dict[str, _Turn] = {}


def do_task(name: str, task: bytes) -> tuple[str, bytes]:
    """Do a task of a run in this worker's process for it.

    Returns:
        ``done`` and the pickled result, or why there is none: ``unknown`` run (and this worker), ``refused`` (and the
        sentence), ``died``, or ``unwanted``.
    """
    from distributed import get_worker
    from distributed.worker import thread_state

    worker, key = get_worker(), thread_state.key
    host = _hosts.get((worker.address, name))
    if host is None:
        return "unknown", worker.address.encode()

    def is_wanted() -> bool:
        state = worker.state.tasks.get(key)
        running = worker.status.name in ("running", "paused")
        return running and not host.closed and state is not None and state.state in ("executing", "long-running")

    try:
        return host.do(task, is_wanted)
    finally:
        worker.loop.add_callback(worker.loop.call_later, IDLE, rest, worker.address, name)


def rest(worker: str, name: str) -> None:
    """Forget a run that has had no task for a while; should one come, this worker is told of the run again."""
    host = _hosts.get((worker, name))
    if host is not None and time.monotonic() - host.active >= IDLE - 1 and host.turn.lock.acquire(blocking=False):
        try:
            del _hosts[worker, name]
            host.close()
        finally:
            host.turn.lock.release()


async def forget(name: str, dask_worker: Any = None) -> None:  # noqa: ANN401
    """End what a run is still doing in this worker; returns when it has ended."""
    host = _hosts.pop((dask_worker.address, name), None)
    if host is not None:
        host.closed = True
        end = time.monotonic() + 2 * GRACE
        while host.pool is not None and time.monotonic() < end:
            await asyncio.sleep(0.02)
            if host.turn.lock.acquire(blocking=False):  # no task is running
                try:
                    host.close()
                finally:
                    host.turn.lock.release()


class Host:
    """The process in which a worker does the tasks of a run.

    Args:
        run: the run.
        turn: taken while a task is done.
    """

    def __init__(self, run: ClusterRun, turn: _Turn) -> None:
        self.run, self.turn = run, turn
        self.pool: ProcessPoolExecutor | None = None
        self.closed = False
        self.active = time.monotonic()

    def do(self, task: bytes, is_wanted: Callable[[], bool]) -> tuple[str, bytes]:
        """Do a task, for as long as it is wanted; one that kills its process is tried once more."""
        while not self.turn.lock.acquire(timeout=POLL):
            if not is_wanted():
                return "unwanted", b""
        try:
            for _ in range(2):
                try:
                    if self.pool is None:
                        self.pool = start_process()
                        problem = self.wait(start(self.pool, settle, self.run), is_wanted)
                        if problem:
                            return "refused", problem
                    result = self.wait(start(self.pool, do_here, task), is_wanted)
                    return ("unwanted", b"") if result is None else ("done", result)
                except BrokenProcessPool:
                    self.close()
            return "died", b""
        finally:
            self.active = time.monotonic()
            self.turn.lock.release()

    def wait(self, future: Future[bytes], is_wanted: Callable[[], bool]) -> bytes | None:
        """The result of the process; None if it is not wanted any more, whereupon the process is ended."""
        while True:
            try:
                return future.result(timeout=POLL)
            except TimeoutError:
                if not is_wanted():
                    self.end(future)
                    return None

    def end(self, future: Future[bytes]) -> None:
        """End the process; what it has begun to write is removed."""
        if self.pool is not None:
            local_workers.end_soon(self.pool, [future], grace=0.0)
            self.close()

    def close(self) -> None:
        """Let the process go, which does nothing."""
        pool, self.pool = self.pool, None
        if pool is not None:
            pool.shutdown(wait=True, cancel_futures=True)


def start_process() -> ProcessPoolExecutor:
    """A process for tasks, such as those of a single machine."""
    return local_workers.process_pool(None, 1)


_starting = threading.Lock()  # the environment, which is changed meanwhile, is one for all workers of this process


def start(pool: ProcessPoolExecutor, function: Callable[..., bytes], *arguments: object) -> Future[bytes]:
    """Let the process do something; it is started with the first."""
    me = multiprocessing.current_process()
    # Dask's nanny marks its workers as daemons, which may not start processes: Python would leave their children alone
    # when a worker is killed. Ours end by themselves when their parent does.
    before = getattr(me, "_config", {}).get("daemon", False)
    with _starting, local_workers.starting_processes():
        try:
            getattr(me, "_config", {})["daemon"] = False
            return pool.submit(function, *arguments)
        finally:
            getattr(me, "_config", {})["daemon"] = before


# The process of a worker.

_work: Callable[[Any], Any] | None = None


def settle(run: ClusterRun) -> bytes:
    """Take up a run in this process; why that is impossible, else an empty text."""
    global _work
    try:
        os.chdir(run.folder)
        os.environ.update(run.environment)
        sys.path += [entry for entry in run.search if entry not in sys.path]
        importlib.invalidate_caches()
        _work = pickle.loads(run.work)  # noqa: S301 - see the top of the file
    except Exception as error:
        return f"a worker cannot take up the work ({reason(error)}); {SAME}".encode()
    return b""


def do_here(task: bytes) -> bytes:
    """Do a task; pickled: whether an exception was raised, and the result or the exception."""
    import cloudpickle

    try:
        if _work is None:
            raise RuntimeError("a task came before its run")
        return bytes(cloudpickle.dumps((False, _work(pickle.loads(task)))))  # noqa: S301
    except Exception as error:
        return bytes(cloudpickle.dumps((True, error)))
