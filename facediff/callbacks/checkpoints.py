"""Checkpoints from which training continues exactly, and files that are never half-written.

``last.ckpt`` is the newest state of a run, written at an interval. Training that is stopped in any way (Ctrl-C,
SIGTERM, a cluster's requeue signal, kill -9, a full disk) continues from it with the same data order, random numbers,
schedules, averages and log files, so that weights and curves equal those of a run that was never stopped.
"""

from __future__ import annotations

import csv
import os
import random
import signal
import threading
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import numpy as np
import torch
from lightning.pytorch import LightningModule, Trainer
from lightning.pytorch.callbacks import Checkpoint
from lightning.pytorch.loggers import CSVLogger
from lightning.pytorch.loggers.csv_logs import ExperimentWriter
from lightning.pytorch.plugins.io import TorchCheckpointIO

from facediff.errors import FaceDiffError
from facediff.registry import Range, checks_arguments
from facediff.utils.files import atomic

RANDOM_KEY = "facediff_random_states"
ROWS_KEY = "facediff_logged_rows"


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint next to its place, flushes it to disk and renames it.

    Lightning writes to the temporary folder and moves; between file systems that is a copy onto the old file, and a
    kill or a full disk then destroys the only checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: object = None
    ) -> None:  # noqa: ANN401
        """Write the file whole or not at all; the previous one stays until then.

        Raises:
            FaceDiffError: if the disk is full or the folder cannot be written.
        """
        target = Path(path)
        try:
            with atomic(target) as temporary, temporary.open("wb") as stream:
                torch.save(checkpoint, stream)
                stream.flush()
                os.fsync(stream.fileno())
        except RuntimeError as error:  # torch's zip writer reports a full disk this way
            raise FaceDiffError(
                f"{target}: cannot be written ({str(error).splitlines()[0]}); the previous file, if any, is unchanged. "
                f"Free some disk space and continue with --ckpt_path last"
            ) from error


class LastCheckpoint(Checkpoint):
    """Keeps ``last.ckpt`` up to date, and stops training at the end of a step when a signal asks for it.

    A checkpoint is written between two steps, when the first step is complete, logged and averaged, and nothing of the
    second has happened yet. In addition to what Lightning stores it holds the states of all random-number generators
    and the number of rows in the CSV log.

    Args:
        every_minutes: time between two checkpoints; a kill -9 costs at most that much.
        every_n_steps: training steps between two checkpoints, in place of the time.
        dirpath: folder of ``last.ckpt``; ``checkpoints`` in the run's folder if None.
    """

    @checks_arguments
    def __init__(
        self,
        every_minutes: Annotated[float, Range(above=0)] = 2.0,
        every_n_steps: Annotated[int, Range(1)] | None = None,
        dirpath: str | None = None,
    ) -> None:
        super().__init__()
        self.every_seconds = every_minutes * 60
        self.every_n_steps = every_n_steps
        self.dirpath = dirpath
        self._saved_at = time.monotonic()
        self._saved_step = -1
        self._random_states: list[Mapping[str, Any]] | None = None
        self._loader_states: list[dict[str, int]] = []
        self._signals = DeferredSignals()

    # Saving

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock, let signals wait, and continue with the batch after the last one that was trained on.

        Lightning restores the loaders' states only where nothing has asked for a loader before. A learning-rate
        schedule has, to learn the number of steps, and worker processes then hold batches of the wrong epoch.
        """
        self._saved_at = time.monotonic()
        self._saved_step = trainer.global_step
        # Not before: Lightning notes and restores the handlers that it finds when it starts to train.
        self._signals.install()
        states, self._loader_states = self._loader_states, []
        loaders = trainer.fit_loop._combined_loader
        if states and loaders is not None:
            loaders._load_state_dicts(states)
            iter(trainer.fit_loop._data_fetcher)  # type: ignore[arg-type]

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:  # noqa: ANN401
        """Save if it is time or if a signal waits; restore the random states at the first step after a resume."""
        if self._random_states is not None:
            restore_random_states(self._random_states[min(trainer.global_rank, len(self._random_states) - 1)])
            self._random_states = None
        # At the start of an epoch, Lightning's counters of epochs and steps do not describe one complete state.
        if batch_idx and self.is_due(trainer):
            self.save(trainer, between_steps=True)
        if batch_idx:
            self._signals.deliver()

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save if it is time, and at the end of training, before averaged weights replace the trained ones."""
        finished = trainer.should_stop or trainer.global_step == trainer.max_steps
        finished |= trainer.max_epochs == trainer.current_epoch + 1
        if self.is_due(trainer) or finished:
            self.save(trainer)
        self._signals.deliver()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Give the signals back."""
        self._signals.remove()

    def is_due(self, trainer: Trainer) -> bool:
        """Whether to save now; all processes get the answer of the first one."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return False
        new = trainer.global_step > self._saved_step
        if self.every_n_steps is not None:
            due = new and trainer.global_step % self.every_n_steps == 0
        else:
            due = new and time.monotonic() - self._saved_at >= self.every_seconds
        due |= new and self._signals.waiting is not None
        return bool(trainer.strategy.broadcast(due))

    def save(self, trainer: Trainer, *, between_steps: bool = False) -> None:
        """Write ``last.ckpt``."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        self._between_steps = between_steps
        trainer.save_checkpoint(self.path(trainer))
        self._saved_at = time.monotonic()
        self._saved_step = trainer.global_step

    _between_steps = False

    def path(self, trainer: Trainer) -> Path:
        """Where ``last.ckpt`` of a run lies."""
        folder = self.dirpath or os.path.join(trainer.log_dir or trainer.default_root_dir, "checkpoints")
        return Path(trainer.strategy.broadcast(folder)) / "last.ckpt"

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Add random states and log positions; called on every process and for every checkpoint."""
        checkpoint[RANDOM_KEY] = gathered(trainer, random_states())
        checkpoint[ROWS_KEY] = [
            logger.rows() if isinstance(logger, ResumableCSVLogger) else -1 for logger in trainer.loggers
        ]
        if self._between_steps:
            self._between_steps = False
            # Lightning has counted the batch that is about to be trained as "ready". Without it, its counters say that
            # a step is complete, with validation and logging, and it continues after that step.
            progress = checkpoint["loops"]["fit_loop"]["epoch_loop.batch_progress"]
            for counter in (progress["total"], progress["current"]):
                counter["ready"] = counter["completed"]

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Take the random states for the first step, and drop log rows of steps that will be repeated."""
        self._random_states = checkpoint.get(RANDOM_KEY)
        self._loader_states = checkpoint["loops"]["fit_loop"]["state_dict"].get("combined_loader", [])
        for logger, rows in zip(trainer.loggers, checkpoint.get(ROWS_KEY, ()), strict=False):
            if isinstance(logger, ResumableCSVLogger) and trainer.is_global_zero and rows >= 0:
                logger.keep(rows)


class DeferredSignals:
    """Lets SIGINT, SIGTERM and SIGUSR1 wait until the training step is complete.

    A signal in the middle of a step would leave half-updated weights and optimiser states behind. The handlers that
    were installed before (Python's for Ctrl-C, Lightning's for SIGTERM and for a SLURM requeue) are called afterwards.
    A second Ctrl-C does not wait.

    Attributes:
        waiting: the signal that came first, if any.
    """

    def __init__(self) -> None:
        self.waiting: int | None = None
        self._before: dict[int, Any] = {}

    def install(self) -> None:
        """Take over the signals that somebody handles."""
        if threading.current_thread() is not threading.main_thread():
            return
        for number in (signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGUSR1", signal.SIGTERM)):
            before = signal.getsignal(number)
            if callable(before) and number not in self._before:
                self._before[number] = before
                signal.signal(number, self._note)

    def remove(self) -> None:
        """Put the previous handlers back."""
        for number, before in self._before.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, before)
        self._before = {}

    def deliver(self) -> None:
        """Call the handler of the signal that waits, if one does."""
        if self.waiting is not None:
            number, self.waiting = self.waiting, None
            handler: Callable[[int, FrameType | None], Any] = self._before[number]
            handler(number, None)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT and self.waiting == signal.SIGINT:
            self.deliver()
        elif self.waiting is None:
            self.waiting = number
            if number == signal.SIGINT:
                os.write(2, b"\nfinishing the step (or the validation) and saving; Ctrl-C again stops immediately\n")


def random_states() -> dict[str, Any]:
    """The states of all generators of this process, as tensors and plain data."""
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    version, internal, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "numpy": [
            str(kind),
            torch.from_numpy(np.asarray(keys).astype(np.int64)),
            int(position),
            int(has_gauss),
            float(cached),
        ],
        "python": [version, list(internal), gauss],
    }


def restore_random_states(states: Mapping[str, Any]) -> None:
    """Put :func:`random_states` back."""
    torch.set_rng_state(states["torch"].cpu())
    if len(states["cuda"]) == torch.cuda.device_count() and states["cuda"]:
        torch.cuda.set_rng_state_all([state.cpu() for state in states["cuda"]])
    kind, keys, *rest = states["numpy"]
    np.random.set_state((kind, keys.cpu().numpy().astype(np.uint32), *rest))
    version, internal, gauss = states["python"]
    random.setstate((version, tuple(internal), gauss))


def gathered(trainer: Trainer, value: Any) -> list[Any]:  # noqa: ANN401
    """A value of every process, in the order of their ranks."""
    if trainer.world_size == 1:
        return [value]
    values: list[Any] = [None] * trainer.world_size
    torch.distributed.all_gather_object(values, value)
    return values


class ResumableCSVLogger(CSVLogger):
    """Lightning's CSV logger, except that it continues a file that is there already.

    Lightning's deletes the file of a folder that it is given a second time, and with it the curve of a run up to the
    point where it was stopped.
    """

    def rows(self) -> int:
        """Rows written so far; whatever is pending is written first."""
        self.save()
        path = Path(self.experiment.metrics_file_path)
        return len(read_rows(path)[1]) if path.is_file() else 0

    def keep(self, rows: int) -> None:
        """Keep the first rows only: the steps after them will be repeated."""
        path = Path(self.experiment.metrics_file_path)
        if not path.is_file():
            return
        header, found = read_rows(path)
        if len(found) > rows:
            with atomic(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as stream:
                writer = csv.DictWriter(stream, header)
                writer.writeheader()
                writer.writerows(found[:rows])

    @property
    def experiment(self) -> Any:  # noqa: ANN401 - as in Lightning's logger
        """The writer; it continues the file."""
        if self._experiment is None:
            os.makedirs(self.root_dir, exist_ok=True)
            self._experiment = _ContinuedWriter(log_dir=self.log_dir)
        return self._experiment


class _ContinuedWriter(ExperimentWriter):
    def _check_log_dir_exists(self) -> None:
        path = Path(self.metrics_file_path)
        if path.is_file():
            self.metrics_keys = read_rows(path)[0]


def read_rows(path: Path) -> tuple[list[str], list[dict[str, str]]]:
    """Header and rows of a CSV file; a row that was cut off by a kill is dropped."""
    with path.open(newline="", encoding="utf-8") as stream:
        reader = csv.DictReader(stream)
        rows = [row for row in reader if None not in row.values()]
    return list(reader.fieldnames or []), rows
