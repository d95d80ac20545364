"""Progress on standard error: a bar in a terminal, and elsewhere, as in a cluster's log, a line now and then."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")

BETWEEN_LINES = 60.0
"""Seconds between two lines of a log."""


def on_terminal() -> bool:
    """Whether a bar is visible: both streams lead to a terminal, and neither to a file or another program."""
    return all(stream is not None and stream.isatty() for stream in (sys.stderr, sys.stdout))


@contextmanager
def progress_bar(
    description: str, total: int | None, *, done: int = 0, shown: bool = True
) -> Iterator[Callable[[], object]]:
    """A progress bar of ``total`` steps (None if that is not known), ``done`` of which have been done before.

    Where there is no terminal, a line says every minute how far it is. The function is called after each step.
    """
    if not shown:
        yield lambda: None
        return
    if not sys.stderr.isatty():
        yield _lines(description, total, done)
        return
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    bar = Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(elapsed_when_finished=True),
        console=Console(stderr=True),
        transient=True,
        redirect_stdout=sys.stdout.isatty(),  # else what is printed to a pipe would go to the terminal
    )
    with bar:
        task = bar.add_task(description, total=total, completed=done)
        yield lambda: bar.advance(task)


def _lines(description: str, total: int | None, count: int) -> Callable[[], object]:
    """What counts steps in a log."""
    first, started, last = count, math.nan, time.monotonic()

    def step() -> None:
        nonlocal count, first, started, last
        count, clock = count + 1, time.monotonic()
        if math.isnan(started):  # what comes before the first step says nothing of their pace
            first, started = count, clock
        if clock - last < BETWEEN_LINES or count == total:
            return
        last = clock
        line = f"{description}: {count}"
        if total is not None:
            line += f" of {total}"
            if count > first:
                line += f", {math.ceil((clock - started) / (count - first) * (total - count) / 60)} min left"
        print(line, file=sys.stderr, flush=True)

    return step


def track(items: Iterable[Item], description: str, *, total: int | None = None, shown: bool = True) -> Iterator[Item]:
    """Items one by one, with a progress bar; ``total`` is needed where ``items`` has no length."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(description, total, shown=shown) as step:
        for item in items:
            yield item
            step()
