"""Progress bars on standard error, which are silent where no terminal would show them."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Sized
from contextlib import contextmanager
from typing import TypeVar

Item = TypeVar("Item")


def on_terminal() -> bool:
    """Whether somebody sees a bar: both streams lead to a terminal, and neither to a file or another program."""
    return all(stream is not None and stream.isatty() for stream in (sys.stderr, sys.stdout))


@contextmanager
def progress_bar(
    description: str, total: int | None, *, done: int = 0, shown: bool = True
) -> Iterator[Callable[[], object]]:
    """A progress bar of ``total`` steps (None if that is not known), ``done`` of which have been done before.

    Nothing is shown without a terminal.

    Yields:
        a function to be called after each step.

    Example:
        >>> with progress_bar("clips", 2, shown=False) as step:
        ...     for _ in range(2):
        ...         _ = step()
    """
    if not shown or not sys.stderr.isatty():
        yield lambda: None
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


def track(items: Iterable[Item], description: str, *, total: int | None = None, shown: bool = True) -> Iterator[Item]:
    """Items one by one, with a progress bar; ``total`` is needed where ``items`` has no length."""
    if total is None and isinstance(items, Sized):
        total = len(items)
    with progress_bar(description, total, shown=shown) as step:
        for item in items:
            yield item
            step()
