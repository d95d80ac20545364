"""Running clips in several processes, so that a stop at any moment leaves nothing running and nothing half-written."""

from __future__ import annotations

import errno
import multiprocessing
import os
from collections.abc import Generator, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from multiprocessing.context import BaseContext
from pathlib import Path

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.prepare.job import Job
from facediff.processes import THREAD_VARIABLES, start_worker, unheard

AHEAD = 2
"""Clips handed out per worker at a time: none waits for work, and few are lost when the run is stopped."""
NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)


@dataclass(frozen=True)
class Outcome:
    """What became of a clip.

    Attributes:
        name: the clip.
        frames: frames written; None if it failed.
        problem: the sentence that says why.
        hopeless: the next clip would fail for the same reason: a package is missing or the disk is full.
    """

    name: str
    frames: int | None
    problem: str = ""
    hopeless: bool = False


def attempt(job: Job, out: Path) -> Outcome:
    """Write one clip; an error that the user can put right becomes an outcome."""
    try:
        return Outcome(job.name, job.work(out))
    except FaceDiffError as error:
        cause = error.__cause__
        full = isinstance(cause, OSError) and cause.errno in NO_SPACE
        return Outcome(job.name, None, str(error), full or isinstance(error, MissingExtraError))
    except Exception as error:
        error.add_note(f"while preparing clip {job.name}")
        raise


def run_jobs(jobs: Sequence[Job], out: Path, workers: int) -> Generator[Outcome]:
    """Outcomes as they come; in this process if there is one worker.

    Raises:
        FaceDiffError: if a worker process dies.
    """
    if min(workers, len(jobs)) <= 1:
        for job in jobs:
            yield attempt(job, out)
        return
    with _single_threaded():
        pool = ProcessPoolExecutor(min(workers, len(jobs)), mp_context=_context(jobs), initializer=start_worker)
        try:
            yield from _hand_out(pool, jobs, out, AHEAD * workers)
        except BrokenProcessPool as error:
            raise FaceDiffError(
                f"{out}: a worker process died, perhaps for want of memory; run the same command again with fewer "
                f"--workers, finished clips are kept"
            ) from error
        finally:
            # Clips at work are finished, those that wait are dropped.
            pool.shutdown(wait=True, cancel_futures=True)


def _hand_out(pool: ProcessPoolExecutor, jobs: Sequence[Job], out: Path, ahead: int) -> Iterator[Outcome]:
    """A few clips at a time, since a job may carry its sound with it."""
    waiting = iter(jobs)
    running: set[Future[Outcome]] = set()
    while True:
        while len(running) < ahead and (job := next(waiting, None)) is not None:
            with unheard():
                running.add(pool.submit(partial(attempt, job, out)))
        if not running:
            return
        done, running = wait(running, return_when=FIRST_COMPLETED)
        for future in done:
            yield future.result()


def _context(jobs: Sequence[Job]) -> BaseContext:
    """Never a plain fork: the caller may have started threads.

    A fork server imports what the jobs need once for all workers, instead of once each.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    context = multiprocessing.get_context("forkserver")
    functions = {getattr(job.work, "func", job.work) for job in jobs}
    context.set_forkserver_preload([__name__, "facediff.data.audio", *sorted({f.__module__ for f in functions})])
    return context


@contextmanager
def _single_threaded() -> Iterator[None]:
    """Processes started inside compute on one thread each; there are as many of them as there are processors."""
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
