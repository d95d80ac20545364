"""Running the cells of a plan: each training and each test in a process of its own, several cells at a time.

Results are written as complete files, and an unfinished training continues where it was stopped, bit for bit. So a
benchmark may be killed at any time, and as often as you like.
"""

from __future__ import annotations

import json
import os
import platform
import shutil
import subprocess
import sys
import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import IO, Any

from facediff.benchmark.cells import Cell, Training, training_content, with_code
from facediff.benchmark.results import Result, cell_file, model_result, predictions_result, read_result
from facediff.errors import FaceDiffError
from facediff.metrics import device_name
from facediff.utils.batch import Outcome, run_batch
from facediff.utils.checksums import hash_of
from facediff.utils.files import discard
from facediff.utils.plain_files import load_json, read_json, write_json
from facediff.utils.workers import THREAD_VARIABLES

RUNS, LOGS = "runs", "logs"
STATE = "state.json"
"""In the folder of a training run: how far it has come, and how long that took."""
PAUSE = 0.05
"""Seconds between two looks at whether a process has ended."""
LOGGER = "lightning.pytorch.loggers.CSVLogger"
LAST = Path("version_0", "checkpoints", "last.ckpt")
BEST = Path("version_0", "checkpoints", "best.ckpt")
REPORT = Path("version_0", "test_report.json")


@dataclass(frozen=True)
class Setting:
    """The settings that all cells of a run share."""

    folder: Path  # the benchmark's folder
    protocol: str  # of all scores
    metrics: tuple[str, ...]  # further metrics
    weights: str  # ``last`` or ``best``
    threads: int  # of each process
    # Split of each clip, by the plan's name of a corpus, where predictions are scored
    clips: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    # Arguments of `facediff evaluate` for the truth (folder, frame stride), by corpus
    truths: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    # Data module of each corpus that is no part of facediff, which a checkpoint may not import by itself
    classes: Mapping[str, str] = field(default_factory=dict)
    # Options that name classes of each trained row's model that are no part of facediff, for the same reason
    models: Mapping[str, Mapping[str, str]] = field(default_factory=dict)
    # Folders of corpora by the data config, for checkpoints without one of this machine
    roots: Mapping[str, str] = field(default_factory=dict)
    # How a facediff command is started
    launcher: tuple[str, ...] = (sys.executable, "-m", "facediff.benchmark.exit_with_parent", "facediff")


def pending(cells: Sequence[Cell], folder: Path, *, retry_failed: bool) -> list[Cell]:
    """The cells that have no result yet; those that failed are tried again only if asked."""
    results = [(cell, read_result(cell_file(folder, cell))) for cell in cells]
    return [cell for cell, result in results if result is None or (result.problem and retry_failed)]


def run_cells(
    cells: Sequence[Cell], setting: Setting, *, workers: int | None, scheduler: str | None = ""
) -> Generator[tuple[Cell, Outcome[Result]]]:
    """Run cells, several at a time; each gets its file when it is done, also when it fails."""
    return run_batch(
        partial(run_cell, setting),
        cells,
        workers=workers,
        scheduler=scheduler,
        writes=setting.folder,
        reads=dict.fromkeys(path for cell in cells for path in files_of(cell)),
        record=partial(record_failure, setting.folder),
        survive_bugs=True,
    )


def files_of(cell: Cell) -> list[Path]:
    """The files and folders that a cell reads, except files that other cells make."""
    paths = [cell.root, cell.data, cell.source, *(training.config for training in cell.trainings)]
    return [path for path in paths if isinstance(path, Path) and path.exists()]


def record_failure(folder: Path, cell: Cell, problem: str, _result: Result | None) -> None:
    """Write the reason of a failure in place of a result; results write themselves."""
    if problem:
        Result.failed(cell, problem, machine_of(0)).write(folder)


def run_cell(setting: Setting, cell: Cell) -> Result:
    """Train and score a cell, and write its result."""
    folder = setting.folder / RUNS / cell.folder_name
    folder.mkdir(parents=True, exist_ok=True)
    machine = machine_of(setting.threads)
    if cell.kind == "predictions":
        result = _score_predictions(setting, cell, folder, machine)
    else:
        result = _score_model(setting, cell, folder, machine)
    result.write(setting.folder)
    return result


def _score_model(setting: Setting, cell: Cell, folder: Path, machine: dict[str, Any]) -> Result:
    runner = Runner(setting, folder, cell)
    checkpoints: dict[str, Path] = {}
    for training in cell.trainings:
        checkpoints[training.name] = runner.fit(training, checkpoints, cell)
    checkpoint = cell.source if cell.source is not None else checkpoints[cell.trainings[-1].name]
    run = folder / f"test-{cell.key[:12]}"
    arguments = ["test", "--ckpt_path", str(checkpoint), *run_words(run)]
    metrics = list(dict.fromkeys([*setting.metrics, "real_time_factor"]))
    root = cell.root or (setting.roots.get(cell.corpus) if cell.kind == "checkpoint" else None)
    options = {
        "model.protocol": setting.protocol,
        "model.metrics": metrics,
        **({"data": setting.classes[cell.corpus]} if cell.corpus in setting.classes else {}),
        **setting.models.get(cell.row, {}),
        **({} if root is None else {"data.root": str(root)}),
        **cell.test_options,
    }
    runner.run(run.name, [*arguments, *option_words(options)])
    report = load_json(run / REPORT)
    return model_result(cell, report, machine=machine, measured=runner.measured, source=str(checkpoint))


def _score_predictions(setting: Setting, cell: Cell, folder: Path, machine: dict[str, Any]) -> Result:
    runner = Runner(setting, folder, cell)
    report = folder / f"evaluate-{cell.key[:12]}.json"
    arguments = ["evaluate", str(cell.source), *setting.truths[cell.corpus], "--protocol", setting.protocol]
    arguments += [word for metric in setting.metrics for word in ("--metric", metric)]
    arguments += option_words(cell.options)
    runner.run("evaluate", [*arguments, "--bootstrap", "0", "--quiet", "--json", str(report)])
    content = load_json(report)
    return predictions_result(
        cell, content, setting.clips[cell.corpus], machine=machine, measured=runner.measured, source=str(cell.source)
    )


class Runner:
    """Runs the commands of one cell, and measures them.

    Attributes:
        measured: seconds and bytes of memory of each command, by its step.
    """

    def __init__(self, setting: Setting, folder: Path, cell: Cell) -> None:
        self.setting, self.folder, self.cell = setting, folder, cell
        self.measured: dict[str, dict[str, float | None]] = {}

    def fit(self, training: Training, checkpoints: Mapping[str, Path], cell: Cell) -> Path:
        """Train, or continue a training that was stopped; the checkpoint."""
        folder = self.folder / training.name
        state = read_json(folder / STATE) or {}
        last, best = folder / LAST, folder / BEST
        if not state.get("done") or not (last.is_file() or best.is_file()):
            refuse_changed(training, cell)
            arguments = ["fit", "--config", str(training.config)]
            options = fit_options(training, checkpoints, cell)
            # A training that was killed continues with the time that its last saved state had taken.
            before = 0.0 if state.get("done") else float(state.get("seconds", 0.0))
            if last.is_file() and "started" in state:
                before += max(0.0, last.stat().st_mtime - float(state["started"]))
                arguments += ["--ckpt_path", str(last)]
            elif folder.is_dir():
                discard(folder)
            folder.mkdir(parents=True, exist_ok=True)
            write_json(folder / STATE, {"seconds": before, "started": time.time()})
            self.run(training.name, [*arguments, *run_words(folder), *option_words(options)])
            took = self.measured[training.name]
            took["seconds"] = before + (took["seconds"] or 0.0)
            write_json(folder / STATE, {"done": True, **took})
        else:
            self.measured[training.name] = {key: state.get(key) for key in ("seconds", "memory")}
        checkpoint = best if self.setting.weights == "best" else last
        if not checkpoint.is_file() and training != cell.trainings[-1]:  # only the scored model needs a best one
            checkpoint = last
        if not checkpoint.is_file():
            raise FaceDiffError(
                f"{cell}: {training.config} wrote no {checkpoint.name}; let it write checkpoints, best.ckpt by a "
                f"ModelCheckpoint with filename=best, or write weights: last into the plan (log: {self._log})"
            )
        return checkpoint

    def run(self, step: str, arguments: Sequence[str]) -> None:
        """Run a facediff command to its end."""
        log = self._log
        log.parent.mkdir(parents=True, exist_ok=True)
        environment = {**os.environ, **dict.fromkeys(THREAD_VARIABLES, str(self.setting.threads))}
        started = time.monotonic()
        with log.open("ab") as stream:
            stream.write(f"\n$ facediff {' '.join(arguments)}\n".encode(errors="surrogateescape"))
            stream.flush()
            start = stream.tell()
            program, *module = self.setting.launcher
            program = program if shutil.which(program) else sys.executable  # a cluster's may lie somewhere else
            status, memory = run_process([program, *module, *arguments], environment, stream)
        self.measured[step] = {"seconds": time.monotonic() - started, "memory": memory}
        if status:
            raise FaceDiffError(f"{self.cell}: {arguments[0]} {reason_of(log, start, status)}")

    @property
    def _log(self) -> Path:
        return self.setting.folder / LOGS / f"{self.cell.file_name}.log"


def fit_options(training: Training, checkpoints: Mapping[str, Path], cell: Cell) -> dict[str, Any]:
    """The options of a training: seed, corpus, and the checkpoints of those before it in the place of their names."""
    options: dict[str, Any] = {"seed_everything": cell.seed}
    if cell.data is not None:
        options["data"] = str(cell.data)
    if cell.root is not None:
        options["data.root"] = str(cell.root)
    for name, value in training.options.items():
        for step, checkpoint in checkpoints.items():
            value = str(checkpoint) if value == f"{{{step}}}" else value  # noqa: PLW2901
        options[name] = value
    return options


def refuse_changed(training: Training, cell: Cell) -> None:
    """Refuse files or code edited since the cells were made: the result would bear the hash of the old content."""
    (hashed,) = (entry for entry in cell.trained["trainings"] if entry["name"] == training.name)
    if hash_of(training_content(training)) != hash_of(hashed) or with_code(cell.trained) != cell.trained:
        raise FaceDiffError(
            f"{cell}: {training.config}, a file of its options or its code was changed while the benchmark ran; run "
            f"the benchmark again"
        )


def option_words(options: Mapping[str, Any]) -> list[str]:
    """Options as words of a command line; lists and mappings as JSON."""
    arguments = []
    for name, value in options.items():
        text = value if isinstance(value, str) else json.dumps(value)
        arguments += [f"--{name}"] if value is True and "." not in name else [f"--{name}={text}"]
    return arguments


def run_words(run: Path) -> list[str]:
    """The options that put a run of Lightning's commands into a folder, without bars in the log."""
    return [
        f"--trainer.logger={LOGGER}",
        f"--trainer.logger.save_dir={run.parent}",
        f"--trainer.logger.name={run.name}",
        "--trainer.logger.version=0",
        "--trainer.enable_progress_bar=false",
        "--trainer.enable_model_summary=false",
    ]


def run_process(command: Sequence[str], environment: Mapping[str, str], log: IO[bytes]) -> tuple[int, float | None]:
    """Run a program that ends with this process; its exit status, and the most memory that it had, in bytes."""
    process = subprocess.Popen(  # noqa: S603 - a command of our own
        command, stdin=subprocess.PIPE, stdout=log, stderr=subprocess.STDOUT, env=dict(environment)
    )
    memory: float | None = None
    try:
        if hasattr(os, "wait4"):
            ended = 0
            while not ended:  # a thread is stopped between two looks
                ended, status, usage = os.wait4(process.pid, os.WNOHANG)
                time.sleep(0 if ended else PAUSE)
            process.returncode = os.waitstatus_to_exitcode(status)
            memory = float(usage.ru_maxrss) * (1 if sys.platform == "darwin" else 1024)
        else:
            process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            with suppress(ChildProcessError):
                process.wait()
        if process.stdin is not None:
            process.stdin.close()
    return process.returncode, memory


def reason_of(log: Path, start: int, status: int) -> str:
    """Why a command failed, from the output after a position in its log."""
    if status < 0:
        return f"was killed by signal {-status}, perhaps for lack of memory; run fewer --workers (log: {log})"
    with log.open("rb") as stream:
        stream.seek(max(start, stream.seek(0, os.SEEK_END) - 65536))
        lines = stream.read().decode("utf-8", "replace").splitlines()
    mark = "facediff: error: "
    error = next((line.removeprefix(mark) for line in reversed(lines) if line.startswith(mark)), "")
    return f"failed: {error}" if error else f"ended with status {status}; its log {log} says why"


def machine_of(threads: int) -> dict[str, Any]:
    """The machine, for the speed column."""
    import torch

    gpu = torch.cuda.is_available()
    processor = device_name("cpu").rpartition(",")[0]
    return {
        "processor": processor,
        "processors": os.cpu_count(),
        "threads": threads,
        "gpu": torch.cuda.get_device_name(0) if gpu else None,
        "system": platform.platform(),
        "python": platform.python_version(),
        "torch": str(torch.__version__),
    }
