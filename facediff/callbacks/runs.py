"""The folder of a run: where it is, and how loggers continue in it when training is resumed."""

from __future__ import annotations

import csv
import os
import re
import secrets
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.core.saving import save_hparams_to_yaml
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger

from facediff.data import SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.models import AnimationModel
from facediff.models.checkpoint import read_checkpoint
from facediff.utils.files import LockedError, atomic, locked, remove_partial
from facediff.utils.hub import check_model_source, check_training_source, local_model

STATE_KEY = "facediff_training_state"
"""Key of a checkpoint for the state that Lightning does not keep."""

JOB_FILE = "slurm_job_id"
"""In the folder of a run that SLURM was asked to start again."""

LAST = Path("checkpoints", "last.ckpt")
"""The newest state of a run, in its folder."""

LOCK = "fit.lock"
"""In the folder of a run while it trains."""

CONFIG = "config.yaml"
"""The config of a run, in its folder."""

Entries = Sequence[Mapping[str, Any]]
"""The trainer's loggers as its options state them: ``class_path`` and ``init_args`` of each."""


def require_facediff(callback: Callback, module: LightningModule, data: object) -> AnimationModel:
    """The model of a callback that works with facediff's models and data modules only."""
    if not isinstance(module, AnimationModel) or not isinstance(data, SpeechMotionDataModule):
        raise FaceDiffError(f"{type(callback).__name__} works with facediff's models and data modules only")
    return module


def run_folder(trainer: Trainer) -> Path:
    """The run's folder, where Lightning keeps its checkpoints too.

    Unlike ``trainer.log_dir``, which every process must ask for, this may be asked for by the first one alone.
    """
    logger = trainer.logger
    if logger is None:
        return Path(trainer.default_root_dir)
    if logger.log_dir:
        return Path(logger.log_dir)
    version = logger.version if isinstance(logger.version, str) else f"version_{logger.version}"
    return Path(logger.save_dir or trainer.default_root_dir) / str(logger.name) / version


# Which run is continued.


def run_of(checkpoint: Path) -> Path | None:
    """The folder of the run with this ``last.ckpt``; None for every other file."""
    return checkpoint.parents[1] if checkpoint.parts[-2:] == LAST.parts else None


def runs_folder(trainer: Trainer) -> Path:
    """The folder to which the trainer's first logger adds a folder for every run."""
    logger = trainer.logger
    if logger is None:
        return Path(trainer.default_root_dir)
    return Path(logger.save_dir or trainer.default_root_dir) / str(logger.name or "")


def newest_run(trainer: Trainer, entries: Entries, word: str = "last") -> Path:
    """The run that was written to last, among those that the trainer's first logger would add one to.

    A run that has no ``last.ckpt`` was stopped before its first step, and begins again.
    """
    logger, folder = trainer.logger, runs_folder(trainer)
    runs = [path for path in folder.glob("*") if (path / LAST).is_file() or _began_training(path / CONFIG)]
    if logger is None or _has_version(entries):
        folder = run_folder(trainer)  # there is one only
        runs = [folder] if (folder / LAST).is_file() or (logger and folder.is_dir()) else []
    if not runs:
        raise FaceDiffError(
            f"--ckpt_path {word}: there is no run to continue in {folder}; give the config and the options of the "
            f"run, or omit --ckpt_path to start one"
        )

    def written(run: Path) -> float:
        return (run / LAST if (run / LAST).is_file() else run).stat().st_mtime

    newest = max(runs, key=written)
    saved = [run for run in runs if (run / LAST).is_file()]
    if not (newest / LAST).is_file() and saved:
        earlier = max(saved, key=written)
        raise FaceDiffError(
            f"--ckpt_path {word}: the newest run, {newest}, was stopped before its first step; give --ckpt_path "
            f"{earlier / LAST} to continue the one before, or omit --ckpt_path to start again"
        )
    return newest


def best_checkpoint(run: Path) -> Path:
    """The best checkpoint of a run by the bookkeeping of its ``ModelCheckpoint``, which ``last.ckpt`` holds."""
    callbacks = read_checkpoint(run / LAST).get("callbacks", {}) if (run / LAST).is_file() else {}
    paths = [Path(state["best_model_path"]) for state in callbacks.values() if state.get("best_model_path")]
    # The folder may have another name by now.
    files = [file for path in paths for file in ((run / LAST).with_name(path.name), path) if file.is_file()]
    if not files:
        raise FaceDiffError(
            f"--ckpt_path best: {run} has none; expected a run that has validated, with a ModelCheckpoint that "
            f"monitors a score"
        )
    return files[0]


def _has_version(entries: Entries) -> bool:
    """Whether the options say in which of the runs' folders the run is."""
    first = entries[0] if entries else {}
    return (first.get("init_args") or {}).get("version") is not None and not first["class_path"].endswith("WandbLogger")


def _began_training(config: Path) -> bool:
    """Whether a config is of a run of ``fit``; configs of scoring are next to it, with options of their own."""
    if not config.is_file():
        return False
    return re.search(r"^(verbose|return_predictions):", config.read_text("utf-8", "replace"), re.MULTILINE) is None


def find_scored(trainer: Trainer, entries: Entries, word: str | None) -> Path | None:
    """The checkpoint to score: a path, or ``last`` or ``best`` of the run that would be continued; None for none."""
    if word is None:
        return None
    if word == "best":
        return best_checkpoint(newest_run(trainer, entries, word))
    path = newest_run(trainer, entries) / LAST if word == "last" else word
    check_model_source(path, "--ckpt_path")
    return local_model(path)


def find_checkpoint(trainer: Trainer, entries: Entries, word: str | None) -> Path | None:
    """The checkpoint to continue from, which may not be there yet; None for a new run.

    ``word`` is a path, ``last``, ``best``, or None: a job that SLURM has started again continues its run then.
    """
    if word is not None:
        if word in ("last", "best"):
            run = newest_run(trainer, entries, word)
            return run / LAST if word == "last" else best_checkpoint(run)
        check_training_source(word)
        return Path(word)
    if int(os.environ.get("SLURM_RESTART_COUNT") or 0):
        job, folder = job_text(), runs_folder(trainer)
        for run in folder.glob("*") if trainer.logger else [folder]:
            if (run / JOB_FILE).is_file() and (run / JOB_FILE).read_text(encoding="utf-8") == job:
                return run / LAST
    return None


def job_text() -> str:
    """The job of SLURM and the command: a job may train several runs of one name, and begins with the first again."""
    return f"{os.environ.get('SLURM_JOB_ID', '')}\n{sys.argv[1:]!a}"


def continued_run(
    trainer: Trainer, entries: Entries, path: Path | None, content: Mapping[str, Any], arguments: Sequence[str]
) -> Path | None:
    """The folder of the run that training continues; None for a new run.

    Training from any other file than a ``last.ckpt``, or with another folder on the command line, is a new run.
    """
    run = None if path is None or trainer.logger is None else run_of(path)
    folder_option = re.compile(r"--name\b|--trainer\.logger\.(init_args\.)?(save_dir|name|version)\b")
    if run is not None and any(folder_option.match(word) for word in arguments):
        one = _has_version(entries)
        stated, present = (run_folder(trainer), run) if one else (runs_folder(trainer), run.parent)
        run = run if os.path.realpath(present) == os.path.realpath(stated) else None
    if run is not None and not content:
        print(f"{run}: was stopped before its first step; training starts from the beginning", flush=True)
    return run


@contextmanager
def entered_run(
    trainer: Trainer, entries: Entries, run: Path | None = None, content: Mapping[str, Any] | None = None
) -> Iterator[None]:
    """Give the trainer the loggers of a run, and keep a second ``fit`` out of the run's folder while the block runs.

    A new run gets the next number where another process has just taken the one that its loggers would take.
    """
    checkpoints = trainer.checkpoint_callbacks
    numbered = run is None and isinstance(trainer.logger, CSVLogger | TensorBoardLogger) and not _has_version(entries)
    while True:
        trainer.loggers = run_loggers(trainer.loggers, entries, run, content or {})
        with ExitStack() as stack:
            if trainer.is_global_zero and (trainer.logger is not None or checkpoints):
                own = run_folder(trainer)
                left = [lock.parent for lock in own.parent.glob(f"*/{LOCK}")]  # of killed runs and of those at work
                try:
                    stack.enter_context(locked(own / LOCK, "facediff fit"))
                except LockedError:
                    if numbered and entries:
                        continue  # new loggers look for a free number again
                    raise
                for folder in left:  # no other: half-written files elsewhere may be of a command at work
                    held = nullcontext() if folder == own else locked(folder / LOCK, "")
                    with suppress(FaceDiffError, OSError), held:
                        remove_partial(folder, recursive=True)
            yield
            return


# The loggers of a run that is continued.


def run_loggers(
    loggers: Sequence[Logger], entries: Entries, run: Path | None = None, content: Mapping[str, Any] | None = None
) -> list[Logger]:
    """The loggers of the options, such that they continue the logs of a run by a checkpoint's content.

    TensorBoard hides the values of later steps than the checkpoint's.
    """
    versions = (content or {}).get(STATE_KEY, {}).get("versions", ())
    resumed: list[Logger] = []
    for index, logger in enumerate(loggers):
        entry = entries[index] if index < len(entries) else {}
        options = {**(entry.get("init_args") or {}), **(entry.get("dict_kwargs") or {})}
        version = versions[index] if index < len(versions) and run is not None else None
        if run is not None and index == 0:
            version = version or run.name
            if isinstance(logger, CSVLogger | TensorBoardLogger):
                options |= {"save_dir": str(run.parent), "name": ""}
                version = run.name
        if isinstance(logger, CSVLogger) and entry:
            logger = ResumableCSVLogger(**{**options, **({} if version is None else {"version": version})})  # noqa: PLW2901
            logger.continues = version is not None
        elif isinstance(logger, TensorBoardLogger) and entry:
            # A second logger would find the folder that the first has made, and take the next number.
            first = entries[0].get("init_args") or {}
            shared = index and all(first.get(name) == options.get(name) for name in ("save_dir", "name"))
            if version is None and shared and options.get("version") is None:
                version = resumed[0].version
            options |= {} if version is None else {"version": version}
            options |= {} if run is None else {"purge_step": (content or {}).get("global_step", 0)}
            logger = TensorBoardLogger(**options)  # noqa: PLW2901
        elif isinstance(logger, WandbLogger) and entry and (run is not None or index == 0):
            # The folder is known from now on, and not once wandb uploads.
            stated = options.get("version") or options.get("id") or os.environ.get("WANDB_RUN_ID")
            options["version"] = version if run is not None else stated or secrets.token_hex(4)
            logger = WandbLogger(**options)  # noqa: PLW2901
        resumed.append(logger)
    return resumed


def logger_versions(trainer: Trainer) -> list[Any]:
    """The version of each logger's run: a number, a name, an identifier of Weights & Biases."""
    return [logger.version if isinstance(logger.version, int | str) else None for logger in trainer.loggers]


class ResumableCSVLogger(CSVLogger):
    """Lightning's CSV logger, except that it can continue a file, and that a kill cannot cut or lose the file.

    Lightning's deletes the file of a folder that it is given a second time as soon as it starts, and with it the curve
    of a run up to the point where it was stopped.
    """

    continues = False
    table: MetricsFile | None = None

    def rows(self) -> int:
        """Rows written so far; pending ones are written first."""
        self.save()
        table = self.experiment
        return len(read_rows(table.path)[1]) if table.columns and table.path.is_file() else 0

    def keep(self, rows: int) -> None:
        """Keep the first rows only: the steps after them will be repeated."""
        path = self.experiment.path
        if self.continues and not rows:  # the file may be of an earlier run
            self.table = MetricsFile(Path(self.log_dir))
        elif self.continues and path.is_file():
            header, written = read_rows(path)
            write_table(path, header, written[:rows])

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:  # noqa: ANN401 - as in Lightning's logger
        """The file."""
        if self.table is None:
            self.table = MetricsFile(Path(self.log_dir), continues=self.continues)
        return self.table

    def finalize(self, status: str) -> None:
        """Write pending rows."""
        if self.table is not None:
            self.save()


class MetricsFile:
    """``metrics.csv`` and ``hparams.yaml`` of a run; an earlier run's file stays until the first rows replace it."""

    def __init__(self, folder: Path, *, continues: bool = False) -> None:
        self.path = folder / "metrics.csv"
        self.metrics: list[dict[str, Any]] = []  # not written yet
        self.columns = read_rows(self.path)[0] if continues and self.path.is_file() else []
        self.hparams: dict[str, Any] = {}

    def log_metrics(self, metrics: Mapping[str, Any], step: int) -> None:
        """Add a row."""
        values = {name: value.item() if hasattr(value, "item") else value for name, value in metrics.items()}
        self.metrics.append({**values, "step": step})

    def log_hparams(self, params: Mapping[str, Any]) -> None:
        """Add to ``hparams.yaml``."""
        self.hparams.update(params)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        save_hparams_to_yaml(str(self.path.with_name("hparams.yaml")), self.hparams)

    def save(self) -> None:
        """Write the rows that are pending; a new column is written to the rows before it, too."""
        columns = sorted({*self.columns, *(name for row in self.metrics for name in row)})
        if not self.metrics:
            return
        if columns == self.columns:
            with self.path.open("a", newline="", encoding="utf-8") as stream:
                csv.DictWriter(stream, columns).writerows(self.metrics)
        else:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            before = read_rows(self.path)[1] if self.columns else []
            write_table(self.path, columns, [*before, *self.metrics])
        self.columns, self.metrics = columns, []


def read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Header and rows of a CSV file; a last row that was cut off by a kill is dropped."""
    text = path.read_text(encoding="utf-8")
    reader = csv.DictReader(text[: text.rfind("\n") + 1].splitlines())
    return list(reader.fieldnames or []), list(reader)


def write_table(path: Path, header: Sequence[str], rows: Sequence[Mapping[str, Any]]) -> None:
    """Write a CSV file whole or not at all."""
    with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, header)
        writer.writeheader()
        writer.writerows(rows)
