"""Batches that can be stopped and continued: a task that fails stops no other, and no finished task is repeated."""

from __future__ import annotations

import errno
import json
import sys
import time
import traceback
from collections.abc import Callable, Generator, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Generic, TypeVar, cast

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.utils.checksums import sha256
from facediff.utils.files import remove_partial, short_name
from facediff.utils.jobs import SetupError, run_tasks
from facediff.utils.limits import quoted
from facediff.utils.plain_files import parse_json, read_json, write_json
from facediff.utils.workers import WorkerDied

Task = TypeVar("Task")
Result = TypeVar("Result")

NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
RECORDS = ".facediff-batch"
"""Hidden folder next to the outputs of a batch; it holds one small file for each output."""


@dataclass(frozen=True)
class Outcome(Generic[Result]):
    """A task's result, or why it failed (``fatal``: all others would fail alike); of a bug, the ``trace`` as well."""

    result: Result | None = None
    problem: str = ""
    seconds: float = 0.0
    fatal: bool = False
    trace: str = ""


def run_batch(
    work: Callable[[Task], Result],
    tasks: Sequence[Task],
    *,
    record: Callable[[Task, str, Result | None], None] | None = None,
    survive_bugs: bool = False,
    **options: Any,  # noqa: ANN401
) -> Generator[tuple[Task, Outcome[Result]]]:
    """Do tasks in several workers past failures, as :func:`~facediff.utils.jobs.run_tasks` does them.

    Args:
        work: does a task; picklable, such as :class:`~facediff.utils.jobs.PerWorker`.
        tasks: errors name a task by its ``str()``.
        record: called with each task that is done, its problem and its result, in the worker, so that tasks that end
            after Ctrl-C are recorded too; picklable.
        survive_bugs: whether an exception that is no :class:`FaceDiffError` is printed and counts as a failure of the
            task; it is raised otherwise.
        options: further ones of :func:`~facediff.utils.jobs.run_tasks`.
    """
    with closing(run_tasks(partial(_attempt, work, record, survive_bugs), tasks, **options)) as results:
        for task, outcome in results:
            if isinstance(outcome, WorkerDied):
                problem = f"{task}: killed its process, perhaps for lack of memory; try --workers 1"
                outcome = Outcome(problem=problem)
                if record is not None:
                    record(task, problem, None)
            if outcome.trace:  # printed here, since a worker's standard error may be a log on another machine
                print(outcome.trace, end="", file=sys.stderr, flush=True)
            if outcome.fatal:
                raise FaceDiffError(outcome.problem)
            yield task, outcome


def do_all(work: Callable[[Task], Result], tasks: Sequence[Task], **options: Any) -> list[Result]:  # noqa: ANN401
    """The results, in their order, of tasks that must all succeed; the first that fails is reported at the end."""
    outcomes = dict(run_batch(work, tasks, **options))
    if problem := next(filter(None, (outcomes[task].problem for task in tasks)), ""):
        raise FaceDiffError(problem)
    return [cast(Result, outcomes[task].result) for task in tasks]


def begin_folder(
    out: Path, state: str, recipe: Mapping[str, Any], command: str, complete: Mapping[str, Any] | None = None
) -> None:
    """Begin or continue a folder, which a killed run has left; a folder of anything else is refused.

    Args:
        out: the folder; the caller holds a lock.
        state: file in it that holds the recipe while the folder is unfinished, in which time readers refuse it.
        recipe: all that determines the bytes of the output, plain data; a run is continued only with the same.
        command: for messages.
        complete: the recipe of a finished folder that lacks something.
    """
    recipe = parse_json(json.dumps(recipe), state)  # as the file will hold it: lists, no tuples
    earlier = read_json(out / state) or complete
    if earlier is None and (files := [path.name for path in sorted(out.iterdir()) if not path.name.startswith(".")]):
        raise FaceDiffError(
            f"{out}: holds other files ({', '.join(files[:3])}{' …' if len(files) > 3 else ''}) and was not begun by "
            f"`{command}`; choose a new folder"
        )
    if earlier is not None:
        settings = {name: (earlier.get(name), recipe.get(name)) for name in {**earlier, **recipe}}
        changes = [
            f"{name} was {quoted(old)} and is {quoted(new)}" for name, (old, new) in settings.items() if old != new
        ]
        if changes:
            raise FaceDiffError(
                f"{out}: was begun with other settings ({'; '.join(changes)}); use the same, choose another folder, or "
                f"remove this one"
            )
    write_json(out / state, recipe)
    remove_partial(out, recursive=True)


def _attempt(
    work: Callable[[Task], Result],
    record: Callable[[Task, str, Result | None], None] | None,
    survive_bugs: bool,
    task: Task,
) -> Outcome[Result]:
    started = time.monotonic()
    try:
        outcome = Outcome(work(task))
    except FaceDiffError as error:
        if _is_full(error) or isinstance(error, SetupError | MissingExtraError):
            return Outcome(problem=error.on_command_line, fatal=True)
        outcome = Outcome(problem=error.on_command_line)
    except OSError as error:
        if _is_full(error):
            return Outcome(problem=f"{task}: {error.strerror}", fatal=True)
        outcome = Outcome(problem=f"{task}: {error.strerror or error}; check that it exists and may be used")
    except Exception as error:
        if not survive_bugs:
            error.add_note(f"while working on {task}")
            raise
        problem = f"{task}: {type(error).__name__}: {error} (see the traceback above)"
        outcome = Outcome(problem=problem, trace=traceback.format_exc())
    if record is not None:
        record(task, outcome.problem, outcome.result)
    return replace(outcome, seconds=time.monotonic() - started)


def _is_full(error: BaseException | None) -> bool:
    """Whether there was no room."""
    return error is not None and (getattr(error, "errno", None) in NO_SPACE or _is_full(error.__cause__))


# Is an output still current? One small file records its sources.


@dataclass(frozen=True)
class Recipe:
    """What decides an output in addition to its source: options, and SHA-256 of the files that they name, by path."""

    command: tuple[str, ...]
    files: Mapping[str, str]

    @classmethod
    def of(cls, command: Sequence[str], files: Sequence[Path]) -> Recipe:
        """Read the files."""
        return cls(tuple(command), {str(path): sha256(path) for path in files})


@dataclass(frozen=True)
class FileTask:
    """A file to make of another one; ``recipe`` is what else decides it.

    The record lies in a hidden folder next to the output, or in ``records`` where the output's folder is handed on.
    """

    source: Path
    output: Path
    recipe: Recipe
    records: Path | None = None

    def __str__(self) -> str:
        return str(self.source)

    @property
    def _record_file(self) -> Path:
        return (self.records or self.output.parent) / RECORDS / f"{short_name(self.output.name, 200)}.json"

    def record(self, problem: str, written: object = None) -> None:
        """Record that the task is done: with a problem, or with a list of all files that it wrote."""
        paths = [path for path in written if isinstance(path, Path)] if isinstance(written, list) else []
        record = {
            "speech": _stat(self.source) | {"sha256": _digest(self.source)},
            "recipe": {"command": list(self.recipe.command), "files": dict(self.recipe.files)},
            "output_bytes": None if problem else self.output.stat().st_size,
            "next_to": {path.name: _bytes(path) for path in paths if path != self.output and path.is_file()},
            "problem": problem,
        }
        write_json(self._record_file, record)

    def earlier_problem(self) -> str | None:
        """The problem that an earlier run recorded; None if nothing is recorded."""
        record = self._read_record()
        return None if record is None else str(record["problem"])

    def change(self) -> str:
        """The reason why the task must be done again, in words; empty if nothing has changed since it was recorded."""
        record = self._read_record()
        if record is None:
            return "it is not known how it was made" if self.output.exists() else ""
        before, files = record["recipe"], self.recipe.files
        if before["command"] != list(self.recipe.command) or before["files"].keys() != files.keys():
            return "the options have changed"
        if changed := [path for path, digest in files.items() if before["files"][path] != digest]:
            return f"{changed[0]} has changed"
        # By path, size and time; where path or time differ, by the content. What could not be read is tried again.
        source, earlier = _stat(self.source), record["speech"]
        unchanged = all(earlier.get(name) == value for name, value in source.items())
        same_size = "bytes" in source and earlier.get("bytes") == source["bytes"]
        if not earlier["sha256"] or not (unchanged or (same_size and earlier["sha256"] == _digest(self.source))):
            return "the recording has changed"
        sizes = {self.output.name: record["output_bytes"], **(record.get("next_to") or {})}
        missing = [name for name, size in sizes.items() if size is None or _bytes(self.output.parent / name) != size]
        return f"{missing[0]} is missing or damaged" if missing and not record["problem"] else ""

    def _read_record(self) -> dict[str, Any] | None:
        record = read_json(self._record_file)
        return record if record and record.keys() >= {"speech", "recipe", "output_bytes", "problem"} else None


def _bytes(path: Path) -> int | None:
    """The size of a file; None if there is none."""
    return path.stat().st_size if path.is_file() else None


def _digest(path: Path) -> str:
    """The checksum of a recording; empty if it is gone or may not be read, for which its own task fails."""
    with suppress(FaceDiffError):
        return sha256(path)
    return ""


def _stat(path: Path) -> dict[str, Any]:
    facts: dict[str, Any] = {"path": str(path.resolve())}
    with suppress(OSError):
        stat = path.stat()
        facts |= {"bytes": stat.st_size, "modified_ns": stat.st_mtime_ns}
    return facts
