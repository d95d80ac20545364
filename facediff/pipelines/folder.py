"""Batch mode of ``facediff animate``: many recordings, on all processors, resumable, past failures."""

from __future__ import annotations

import hashlib
import json
import time
import traceback
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from facediff.errors import FaceDiffError, MissingExtraError
from facediff.pipelines.animate import refuse_replacing
from facediff.utils.files import atomic, check_writable, locked, remove_partial, sha256
from facediff.utils.jobs import WorkerDied, processors, run_tasks

# What a batch has made of which recording with which options: one small file beside each output.

STATE = ".facediff-batch"
"""Folder in the output's folder."""
LOCK = ".facediff-batch.lock"
"""Next to the outputs while a batch is running."""


@dataclass(frozen=True)
class Recipe:
    """What decides an output, beside the recording.

    Attributes:
        command: the options.
        files: SHA-256 of what they name (checkpoint, styles …), by path.
    """

    command: tuple[str, ...]
    files: Mapping[str, str]

    @classmethod
    def of(cls, command: Sequence[str], files: Sequence[Path]) -> Recipe:
        """Read the files.

        Raises:
            FaceDiffError: if one is not there.
        """
        for path in files:
            if not path.is_file():
                raise FaceDiffError(f"{path}: no such file")
        return cls(tuple(command), {str(path): sha256(path) for path in files})


def record_file(output: Path) -> Path:
    """Where the record of an output lies."""
    return output.parent / STATE / f"{output.name}.json"


def read_record(output: Path) -> dict[str, Any] | None:
    """The record of an output; None if there is none, or it cannot be read."""
    try:
        record = json.loads(record_file(output).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return record if isinstance(record, dict) and isinstance(record.get("speech"), dict) else None


def write_record(speech: Path, output: Path, recipe: Recipe, problem: str) -> None:
    """Write down what has become of a recording; an empty problem means that the output is there.

    Raises:
        FaceDiffError: if it cannot be written.
    """
    record = {
        "speech": _facts(speech) | {"sha256": sha256(speech) if speech.is_file() else ""},
        "recipe": asdict(recipe) | {"command": list(recipe.command), "files": dict(recipe.files)},
        "output_bytes": None if problem else output.stat().st_size,
        "problem": problem,
    }
    with atomic(record_file(output)) as temporary:
        temporary.write_text(json.dumps(record, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def _facts(speech: Path) -> dict[str, Any]:
    try:
        stat = speech.stat()
    except OSError:
        return {"path": str(speech.resolve())}
    return {"path": str(speech.resolve()), "bytes": stat.st_size, "modified_ns": stat.st_mtime_ns}


def difference(record: Mapping[str, Any], speech: Path, output: Path, recipe: Recipe) -> str:
    """What has changed since a record was written, in words; empty if nothing has."""
    before = record.get("recipe") or {}
    if before.get("command") != list(recipe.command):
        return "the options have changed"
    known = before.get("files") or {}
    for path, digest in recipe.files.items():
        if known.get(path) != digest:
            return f"{path} has changed"
    if known.keys() != recipe.files.keys():
        return "the options have changed"
    if not _same_speech(record["speech"], speech):
        return "the recording has changed"
    if not record.get("problem") and not (output.is_file() and output.stat().st_size == record.get("output_bytes")):
        return "the output is gone or damaged"
    return ""


def _same_speech(known: Mapping[str, Any], speech: Path) -> bool:
    """By place, size and time; where place or time differ, by the bytes."""
    facts = _facts(speech)
    if all(known.get(name) == value for name, value in facts.items()):
        return True
    return speech.is_file() and known.get("bytes") == facts.get("bytes") and known.get("sha256") == sha256(speech)


Animate = Callable[[Path, Path], None]
"""Animates a recording (first) and writes a file (second), whole or not at all."""
MakeWorker = Callable[[list[str]], Animate]
"""Gets the command's words and loads what all recordings have in common."""

TABLE = 40
"""Recordings that the table at the end shows; of more, only the failed ones."""


@dataclass(frozen=True)
class Task:
    """A recording to animate.

    Attributes:
        speech: the recording.
        output: the file to write.
        recipe: what else decides it.
    """

    speech: Path
    output: Path
    recipe: Recipe


@dataclass(frozen=True)
class Outcome:
    """What became of a recording.

    Attributes:
        problem: the sentence that says why it failed; empty if it did not.
        seconds: how long it took.
        hopeless: the next one would fail for the same reason.
    """

    problem: str = ""
    seconds: float = 0.0
    hopeless: bool = False


@dataclass
class Work:
    """What a worker process does: it loads the model once, and animates recording after recording.

    Attributes:
        make_worker: a function of a module.
        command: its argument.
    """

    make_worker: MakeWorker
    command: list[str]
    _animate: Animate | None = field(default=None, init=False)

    def __call__(self, task: Task) -> Outcome:
        """Animate a recording and write down that it is done; whatever goes wrong becomes a sentence."""
        if self._animate is None:
            try:
                self._animate = self.make_worker(self.command)
            except FaceDiffError as error:
                return Outcome(str(error), hopeless=True)
        started, problem = time.monotonic(), ""
        try:
            self._animate(task.speech, task.output)
        except FaceDiffError as error:
            problem = str(error)
            if isinstance(error, MissingExtraError) or _disk_full(error):
                return Outcome(problem, hopeless=True)
        except Exception as error:
            traceback.print_exc()
            problem = f"{task.speech}: {type(error).__name__}: {error} (see the traceback above)"
        write_record(task.speech, task.output, task.recipe, problem)
        return Outcome(problem, time.monotonic() - started)


def _disk_full(error: FaceDiffError) -> bool:
    from facediff.data.prepare.runner import NO_SPACE

    return isinstance(error.__cause__, OSError) and error.__cause__.errno in NO_SPACE


def recordings(paths: Sequence[Path]) -> list[Path]:
    """Recordings, and those that lie in folders (not deeper), each once.

    Raises:
        FaceDiffError: if a folder has none. A file that is missing fails later, by itself.
    """
    from facediff.data.audio import CONTAINERS, SUFFIXES

    known = SUFFIXES + CONTAINERS
    found: dict[Path, Path] = {}
    for path in paths:
        files = [path]
        if path.is_dir():
            files = [file for file in sorted(path.iterdir()) if file.suffix.lower() in known and file.is_file()]
            files = [file for file in files if not file.name.startswith(".")]
            if not files:
                raise FaceDiffError(f"{path}: holds no recording; expected {', '.join(known)}")
        if not path.exists():
            raise FaceDiffError(f"{path}: no such file or folder of recordings")
        for file in files:
            found.setdefault(file.resolve(), file)
    return list(found.values())


def output_names(speeches: Sequence[Path], suffix: str) -> list[str]:
    """Names of the outputs: ``a.wav`` gives ``a.mp4``; where two would be equal, ``a.wav.mp4`` and ``a.flac.mp4``.

    Letters' case does not tell names apart, as on many disks.

    Raises:
        FaceDiffError: if two recordings have the same name.
    """
    stems = Counter(speech.stem.lower() for speech in speeches)
    names = [(speech.stem if stems[speech.stem.lower()] == 1 else speech.name) + suffix for speech in speeches]
    first: dict[str, Path] = {}
    for name, speech in zip(names, speeches, strict=True):
        if (other := first.setdefault(name.lower(), speech)) is not speech:
            raise FaceDiffError(f"{other} and {speech} would both give {name}; rename one, or animate them one by one")
    return names


def seed_of_recording(speech: Path, seed: int) -> int:
    """The seed of a recording in a batch: it follows from the file's name, not from its place or its worker."""
    digest = hashlib.sha256(f"{seed}/{speech.name}".encode()).digest()
    return int.from_bytes(digest[:4], "big") >> 1


def run_folder(
    speeches: Sequence[Path],
    output: Path,
    suffix: str,
    command: Sequence[str],
    *,
    make_worker: MakeWorker,
    files: Sequence[Path] = (),
    workers: int | None = None,
    retry_failed: bool = False,
) -> int:
    """Animate recordings into a folder.

    What an earlier run has made of the same recording, options and files is kept, and a recording that failed is not
    tried again unless something has changed or it is wished. Each output appears whole or not at all. Ctrl-C waits for
    the recordings at work; the same command goes on.

    Args:
        speeches: recordings.
        output: folder for the outputs.
        suffix: of the outputs (``.mp4``).
        command: the options that decide the result, without recordings, output and workers.
        make_worker: a function of a module; called once in each process with the command.
        files: files that the command names and that decide the result (checkpoint, styles …).
        workers: processes; as many as processors if None.
        retry_failed: try failed recordings again.

    Returns:
        the exit status: 0 if all outputs are there, 1 if a recording failed.

    Raises:
        FaceDiffError: if nothing can be made at all: the folder, the options or the checkpoint are no good.
    """
    if workers is not None and workers < 1:
        raise FaceDiffError(f"--workers {workers}: expected 1 or more")
    if output.exists() and not output.is_dir():
        raise FaceDiffError(f"--output {output}: is a file; expected a folder, since there are several recordings")
    if not speeches:
        raise FaceDiffError("speech: no recording; give some, or a folder of them")
    names = output_names(speeches, suffix)
    refuse_replacing(speeches, [output / name for name in names])
    recipe = Recipe.of(command, files)
    check_writable(output / names[0])
    results: dict[Path, tuple[str, str]] = {}
    with locked(output / LOCK, "facediff animate"):
        tasks = []
        for speech, name in zip(speeches, names, strict=True):
            task = Task(speech, output / name, recipe)
            known = known_result(task, retry_failed)
            if known is None:
                remove_partial(output, task.output.stem)
                tasks.append(task)
            else:
                results[speech] = known
        try:
            _carry_out(Work(make_worker, list(command)), tasks, workers or processors(), results)
        finally:
            _tell(speeches, results)
    return int(any(state == "failed" for state, _ in results.values()))


def known_result(task: Task, retry_failed: bool) -> tuple[str, str] | None:
    """What an earlier run has left of a recording: its state and its problem; None if it is to be animated."""
    record = read_record(task.output)
    if record is None:
        if task.output.exists():
            print(f"note: {task.output}: is made anew, since it is not known how it was made")
        return None
    changed = difference(record, task.speech, task.output, task.recipe)
    if changed:
        print(f"note: {task.output}: is made anew, since {changed}")
        return None
    if not record.get("problem"):
        return "up to date", ""
    return None if retry_failed else ("failed", f"{record['problem']} (in an earlier run; --retry-failed tries again)")


def _carry_out(work: Work, tasks: Sequence[Task], workers: int, results: dict[Path, tuple[str, str]]) -> None:
    with closing(run_tasks(work, tasks, workers=workers)) as outcomes:
        for place, (task, outcome) in enumerate(outcomes, start=1):
            if isinstance(outcome, WorkerDied):
                outcome = Outcome(f"{task.speech}: killed its process, perhaps for want of memory; try --workers 1")
                write_record(task.speech, task.output, task.recipe, outcome.problem)
            if outcome.hopeless:
                raise FaceDiffError(outcome.problem)
            if outcome.problem:
                stale = f" ({task.output} is of an earlier run)" if task.output.exists() else ""
                results[task.speech] = "failed", outcome.problem + stale
                print(f"[{place}/{len(tasks)}] failed: {outcome.problem}", flush=True)
            else:
                results[task.speech] = "made", f"{outcome.seconds:.1f} s"
                print(f"[{place}/{len(tasks)}] {task.output}, {outcome.seconds:.1f} s", flush=True)


def _tell(speeches: Sequence[Path], results: dict[Path, tuple[str, str]]) -> None:
    """The table at the end."""
    left = [(speech, *results.get(speech, ("left", ""))) for speech in speeches]
    shown = left if len(left) <= TABLE else [row for row in left if row[1] == "failed"]
    width = max((len(str(speech.name)) for speech, _, _ in shown), default=0)
    for speech, state, words in shown:
        print(f"{speech.name:<{width}}  {state:<10}  {words}".rstrip())
    counts = Counter(state for _, state, _ in left)
    told = ", ".join(f"{count} {state}" for state, count in counts.items())
    print(f"{len(left)} recording{'s' * (len(left) != 1)}: {told}", flush=True)
    if counts["left"]:
        print("the same command goes on where this one stopped", flush=True)
