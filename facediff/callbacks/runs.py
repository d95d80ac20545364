"""The folder of a run: where it is, and how loggers continue in it when training is resumed."""

from __future__ import annotations

import csv
import os
import re
import secrets
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lightning.fabric.loggers.logger import rank_zero_experiment
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger, Logger, TensorBoardLogger, WandbLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter

from facediff.errors import FaceDiffError
from facediff.utils.files import LockedError, atomic, locked, sweep
from facediff.utils.hub import check_model_source, check_training_source, local_model

STATE_KEY = "facediff_training_state"
"""Where a checkpoint holds what Lightning does not keep."""

JOB_FILE = "slurm_job_id"
"""In the folder of a run that SLURM was asked to start again."""

LAST = Path("checkpoints", "last.ckpt")
"""The newest state of a run, in its folder."""

LOCK = "fit.lock"
"""In the folder of a run while it trains."""

CONFIG = "config.yaml"
"""The config of a run, in its folder."""


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
    """The folder of the run whose ``last.ckpt`` a file is; None for every other file."""
    return checkpoint.parents[1] if checkpoint.parts[-2:] == LAST.parts else None


def runs_folder(trainer: Trainer) -> Path:
    """The folder to which the trainer's first logger adds a folder for every run."""
    logger = trainer.logger
    if logger is None:
        return Path(trainer.default_root_dir)
    return Path(logger.save_dir or trainer.default_root_dir) / str(logger.name or "")


def newest_run(trainer: Trainer) -> Path:
    """The run that was written to last, among those that the trainer's first logger would add one to.

    A run that has no ``last.ckpt`` was stopped before its first step, and begins again.

    Raises:
        FaceDiffError: if there is no run, or if the newest has no checkpoint while an older one has.
    """
    logger, folder = trainer.logger, runs_folder(trainer)
    runs = [path for path in folder.glob("*") if (path / LAST).is_file() or _began_training(path / CONFIG)]
    if logger is None or _has_version(logger):
        folder = run_folder(trainer)  # there is one only
        runs = [folder] if (folder / LAST).is_file() or (logger and folder.is_dir()) else []
    if not runs:
        raise FaceDiffError(
            f"--ckpt_path last: there is no run to continue in {folder}; give the config and the options of the run, "
            f"or omit --ckpt_path to start one"
        )

    def written(run: Path) -> float:
        return (run / LAST if (run / LAST).is_file() else run).stat().st_mtime

    newest = max(runs, key=written)
    saved = [run for run in runs if (run / LAST).is_file()]
    if not (newest / LAST).is_file() and saved:
        other = max(saved, key=written)
        raise FaceDiffError(
            f"--ckpt_path last: the newest run, {newest}, was stopped before its first step; give --ckpt_path "
            f"{other / LAST} to continue the one before, or omit --ckpt_path to start again"
        )
    return newest


def _has_version(logger: Logger) -> bool:
    """Whether the options say in which of the runs' folders the run is."""
    return getattr(logger, "_version", None) is not None and not isinstance(logger, WandbLogger)


def _began_training(config: Path) -> bool:
    """Whether a config is of a run of ``fit``: those of scoring stand next to them, and have options of their own."""
    if not config.is_file():
        return False
    return re.search(r"^(verbose|return_predictions):", config.read_text("utf-8", "replace"), re.MULTILINE) is None


def find_scored(trainer: Trainer, asked: str | None) -> Path | None:
    """The checkpoint to score, where ``last`` is that of the run that training would continue; None if none is given.

    Raises:
        FaceDiffError: if it is not there.
    """
    if asked is None or asked == "last":
        path = None if asked is None else newest_run(trainer) / LAST
        if path is not None and not path.is_file():
            raise FaceDiffError(f"--ckpt_path {asked}: there is no {path}; expected a .ckpt file of `facediff fit`")
        return path
    check_model_source(asked, "--ckpt_path")
    return local_model(asked)


def find_checkpoint(trainer: Trainer, asked: str | None) -> Path | None:
    """The checkpoint to continue from, which may not be there yet; None for a new run.

    Args:
        trainer: its loggers say where the runs are.
        asked: a path, ``last``, or None; a job that SLURM has started again continues its run then.

    Raises:
        FaceDiffError: if a checkpoint is asked for, and there is none.
    """
    if asked is not None:
        if asked == "last":
            return newest_run(trainer) / LAST
        check_training_source(asked)
        return Path(asked)
    if int(os.environ.get("SLURM_RESTART_COUNT") or 0):
        job, folder = job_text(), runs_folder(trainer)
        for run in folder.glob("*") if trainer.logger else [folder]:
            if (run / JOB_FILE).is_file() and (run / JOB_FILE).read_text(encoding="utf-8") == job:
                return run / LAST
    return None


def job_text() -> str:
    """The job of SLURM and the command: a job may train several runs of one name, and begins with the first again."""
    return f"{os.environ.get('SLURM_JOB_ID', '')}\n{sys.argv[1:]!a}"


def share_folder(loggers: Sequence[Logger]) -> None:
    """Let TensorBoard write into the folder that the first logger makes for a new run, if both count runs in one place.

    Each logger takes the first number that is free when it is asked: the second would find the first one's folder.
    """
    for logger in loggers[1:]:
        same = (logger.save_dir, logger.name) == (loggers[0].save_dir, loggers[0].name)
        if isinstance(logger, TensorBoardLogger) and same and getattr(logger, "_version", None) is None:
            logger._version = loggers[0].version


def continue_run(trainer: Trainer, path: Path | None, content: Mapping[str, Any], arguments: Sequence[str]) -> bool:
    """Prepare the trainer's loggers; whether a run is continued in its folder.

    Training that begins from any other file than a ``last.ckpt``, or with a place for its run on the command line, is
    a new run.

    Args:
        trainer: with loggers that have not been used yet.
        path: the checkpoint that training begins from.
        content: what is in it; empty if it is not there.
        arguments: the command line.
    """
    logger = trainer.logger
    run = None if path is None or logger is None else run_of(path)
    place = re.compile(r"--name\b|--trainer\.logger\.(init_args\.)?(save_dir|name|version)\b")
    if run is not None and logger is not None and any(place.match(word) for word in arguments):
        stated, present = (run_folder(trainer), run) if _has_version(logger) else (runs_folder(trainer), run.parent)
        run = run if os.path.realpath(present) == os.path.realpath(stated) else None
    if run is not None and not content:
        print(f"{run}: was stopped before its first step; training starts from the beginning", flush=True)
    state = content.get(STATE_KEY, {})
    trainer.loggers = resumable(trainer.loggers, run, state.get("versions", ()), content.get("global_step", 0))
    return run is not None


@contextmanager
def locked_run(trainer: Trainer, *, new: bool) -> Iterator[None]:
    """Keep a second ``fit`` out of the run's folder while the block runs.

    Args:
        trainer: with loggers that have not been used yet.
        new: whether the run is a new one: where another process has just taken the number that its loggers would
            take, it gets the next.

    Raises:
        FaceDiffError: if another process trains in the folder.
    """
    logger, checkpoints = trainer.logger, trainer.checkpoint_callbacks
    if not trainer.is_global_zero or (logger is None and not checkpoints):
        yield
        return
    if isinstance(logger, WandbLogger) and logger._id is None:  # the folder is known from now on, not once it uploads
        logger._id = logger._wandb_init["id"] = os.environ.get("WANDB_RUN_ID") or secrets.token_hex(4)
    counts = new and isinstance(logger, CSVLogger | TensorBoardLogger) and logger._version is None
    with ExitStack() as stack:
        while True:
            try:
                stack.enter_context(locked(run_folder(trainer) / LOCK, "facediff fit"))
            except LockedError:
                if not counts:
                    raise
                logger._version = None  # type: ignore[union-attr] # it looks for a free number again
            else:
                break
        for earlier in run_folder(trainer).parent.glob("*/checkpoints"):
            sweep(earlier)  # what a run left that was killed in its first save, which nobody continues
        yield


# The loggers of a run that is continued.


def resumable(
    loggers: Sequence[Logger], run: Path | None = None, versions: Sequence[Any] = (), step: int = 0
) -> list[Logger]:
    """The loggers of a run, such that they continue what they have logged.

    Args:
        loggers: as the config describes them, with nothing logged yet.
        run: the folder of the run that is continued; None for a new run.
        versions: what :func:`logger_versions` was when the run was saved.
        step: optimiser steps that had been taken then; TensorBoard hides what it was shown of later ones.
    """
    ready: list[Logger] = []
    for place, logger in enumerate(loggers):
        version = versions[place] if place < len(versions) else None
        if type(logger) is CSVLogger:
            logger = ResumableCSVLogger(  # noqa: PLW2901
                logger.save_dir,
                name=logger.name,
                version=logger._version,
                prefix=logger._prefix,
                flush_logs_every_n_steps=logger._flush_logs_every_n_steps,
            )
        if run is not None and isinstance(logger, ResumableCSVLogger | TensorBoardLogger):
            if place == 0:
                logger._root_dir, logger._name, version = str(run.parent), "", run.name
                if isinstance(logger, ResumableCSVLogger):
                    logger._save_dir = logger._root_dir
            logger._version = version if version is not None else logger._version
            if isinstance(logger, ResumableCSVLogger):
                logger.continues = version is not None
            else:
                logger._kwargs.setdefault("purge_step", step)
        if run is not None and isinstance(logger, WandbLogger):
            logger._id = logger._wandb_init["id"] = version or (run.name if place == 0 else None)
        ready.append(logger)
    return ready


def logger_versions(trainer: Trainer) -> list[Any]:
    """What tells the runs of each logger apart: a number, a name, an identifier of Weights & Biases."""
    return [logger.version if isinstance(logger.version, int | str) else None for logger in trainer.loggers]


class ResumableCSVLogger(CSVLogger):
    """Lightning's CSV logger, except that it can continue a file, and that a kill cannot cut or lose the file.

    Lightning's deletes the file of a folder that it is given a second time as soon as it starts, and with it the curve
    of a run up to the point where it was stopped.

    Attributes:
        continues: keep the file that is there.
    """

    continues = False

    def rows(self) -> int:
        """Rows written so far; whatever is pending is written first."""
        self.save()
        path = Path(self.experiment.metrics_file_path)
        return len(read_rows(path)[1]) if self.experiment.begun and path.is_file() else 0

    def keep(self, rows: int) -> None:
        """Keep the first rows only: the steps after them will be repeated."""
        path = Path(self.experiment.metrics_file_path)
        if self.continues and not rows:  # the file may be that of a run before
            self._experiment = _Writer(log_dir=self.log_dir)
        elif self.continues and path.is_file():
            header, written = read_rows(path)
            write_table(path, header, written[:rows])

    @property
    @rank_zero_experiment
    def experiment(self) -> Any:  # noqa: ANN401 - as in Lightning's logger
        """The writer."""
        if self._experiment is None:
            os.makedirs(self.root_dir, exist_ok=True)
            self._experiment = (_ContinuedWriter if self.continues else _Writer)(log_dir=self.log_dir)
        return self._experiment


class _Writer(ExperimentWriter):
    """The file of an earlier run stays until the first rows replace it."""

    begun = False

    def _check_log_dir_exists(self) -> None:
        """Do nothing; Lightning's deletes the file."""

    def save(self) -> None:
        """Write the rows that are pending."""
        if self.begun:
            super().save()
        elif self.metrics:
            self._record_new_keys()
            write_table(Path(self.metrics_file_path), self.metrics_keys, self.metrics)
            self.metrics, self.begun = [], True

    def _rewrite_with_new_header(self, fieldnames: list[str]) -> None:
        path = Path(self.metrics_file_path)
        write_table(path, fieldnames, read_rows(path)[1])


class _ContinuedWriter(_Writer):
    def _check_log_dir_exists(self) -> None:
        path = Path(self.metrics_file_path)
        self.begun = path.is_file()
        if self.begun:
            self.metrics_keys = read_rows(path)[0]


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
