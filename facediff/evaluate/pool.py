"""Scoring many clips on all processors."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import contextmanager

import torch

from facediff.evaluate.pairs import Pair
from facediff.evaluate.scoring import ClipScores, Scorer
from facediff.machine import processors


def score_all(
    scorer: Scorer, jobs: Sequence[tuple[str, Pair]], workers: int | None, *, progress: bool = False
) -> dict[str, dict[str, ClipScores | str]]:
    """The scores of every job.

    Threads do it: nearly all of the time goes into torch, which lets other threads run, and a thread starts at once
    where a process would first take seconds, and a hundred megabytes, to import torch.

    Args:
        scorer: scores a clip.
        jobs: method and clip.
        workers: clips that are scored at a time; as many as processors if None.
        progress: whether to show a bar.

    Returns:
        what the scorer said, by method and clip.

    Raises:
        FaceDiffError: the first that a clip raises; clips not yet begun are left.
    """
    found: dict[str, dict[str, ClipScores | str]] = {method: {} for method, _ in jobs}
    with _one_thread_each(), _steps(len(jobs), shown=progress) as step:
        pool = ThreadPoolExecutor(min(workers or processors(), max(len(jobs), 1)))
        try:
            running = {pool.submit(scorer.score, pair): (method, pair.clip) for method, pair in jobs}
            for future in as_completed(running):
                method, clip = running[future]
                found[method][clip] = future.result()
                step()
        finally:
            pool.shutdown(cancel_futures=True)
    return found


@contextmanager
def _one_thread_each() -> Iterator[None]:
    """Keep torch from giving each worker threads of its own; also, digits then do not depend on the machine."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextmanager
def _steps(total: int, *, shown: bool) -> Iterator[Callable[[], object]]:
    """A progress bar on standard error, if it is a terminal and tqdm is there; what is given is called after a clip."""
    try:
        from tqdm import tqdm
    except ImportError:
        shown = False
    if not shown:
        yield lambda: None
        return
    with tqdm(total=total, desc="clips", unit="clip", disable=None) as bar:
        yield bar.update
