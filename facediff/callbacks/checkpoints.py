"""Checkpoints from which training continues exactly, and files that are never half-written.

``last.ckpt`` is the newest state of a run, written at an interval. Training that is stopped in any way (Ctrl-C,
SIGTERM, a cluster's requeue signal, kill -9, a full disk) continues from it with the same data order, random numbers,
schedules, averages and log files, so that weights and curves equal an uninterrupted run's.
"""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import numpy as np
import torch
from lightning.fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning.fabric.plugins.environments.slurm import SLURMEnvironment
from lightning.pytorch import Callback, LightningModule, Trainer
from lightning.pytorch.callbacks import ModelCheckpoint
from lightning.pytorch.plugins.io import TorchCheckpointIO
from lightning.pytorch.trainer.states import TrainerFn

from facediff.callbacks.runs import JOB_FILE, LAST, STATE_KEY, ResumableCSVLogger, job_text, logger_versions, run_folder
from facediff.data import SpeechMotionDataModule
from facediff.errors import FaceDiffError
from facediff.models.checkpoint import read_checkpoint
from facediff.utils.files import atomic
from facediff.utils.hints import checks_arguments
from facediff.utils.ranges import Range
from facediff.utils.torch_files import load_tensors

SHARE_OF_TIME = 0.05
"""The largest share of the training time that saving may take."""


class AtomicCheckpointIO(TorchCheckpointIO):
    """Writes a checkpoint next to its place, flushes it to disk and renames it.

    Lightning writes to the temporary folder and moves; between file systems that is a copy onto the old file, and a
    kill or a full disk then destroys the only checkpoint.
    """

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike[str], storage_options: object = None
    ) -> None:
        """Write the file whole or not at all; the previous one stays until then."""
        target = Path(path)
        try:
            with atomic(target) as temporary, temporary.open("wb") as stream:
                torch.save(checkpoint, stream)
                stream.flush()
                os.fsync(stream.fileno())
        except RuntimeError as error:
            if "inline_container.cc" not in str(error):  # torch's zip writer, which reports a full disk this way
                raise
            raise FaceDiffError(
                f"{target}: cannot be written ({str(error).splitlines()[0]}); the previous file, if any, is unchanged. "
                f"Free some disk space and repeat the command; `facediff fit` continues with --ckpt_path last"
            ) from error

    def load_checkpoint(
        self, path: str | os.PathLike[str], map_location: object = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Read a file as every checkpoint is read; its content cannot ask for a less safe way."""
        if Path(path).name == TRANSFER and (weights := only_weights(Path(path))) is not None:
            return weights
        return read_checkpoint(path)


TRANSFER = ".temp.ckpt"
"""The name under which Lightning hands weights from a forked process to the one that started it."""


def only_weights(path: Path) -> dict[str, Any] | None:
    """The content of a file of tensors by name and nothing else, without classes or options; else None."""
    content = load_tensors(path)
    plain = isinstance(content, dict) and all(isinstance(value, torch.Tensor) for value in content.values())
    return content if plain else None


class Stopped(SystemExit):
    """Training was stopped by a signal, at a point from which it continues."""


class LastCheckpoint(Callback):
    """Keeps ``last.ckpt`` up to date, and stops training at the end of a step when a signal asks for it.

    A checkpoint is written between two steps, when the first step is complete, logged, averaged and validated, and the
    second has not begun. Besides Lightning's content it holds the states of all random-number generators and the
    positions of the loggers. The callback moves to the front of the list: the others have then finished the step
    before, and not begun the next.

    A signal waits for the end of the step, where a checkpoint is written; during validation, which may be long, it
    stops training after the current batch, and validation is repeated.

    Args:
        every_minutes: time between two checkpoints; a kill -9 costs at most that much. It is longer where saving would
            take more than 5 % of the time.
        every_n_steps: training steps between two checkpoints, in place of the time.
    """

    @checks_arguments
    def __init__(
        self,
        every_minutes: Annotated[float, Range(0, above=True)] = 2.0,
        every_n_steps: Annotated[int, Range(1)] | None = None,
    ) -> None:
        super().__init__()
        self.every_seconds = every_minutes * 60
        self.every_n_steps = every_n_steps
        self._signals = DeferredSignals()
        self._saved_at = time.monotonic()
        self._saved_step = -1
        self._place: str | None = None  # where a checkpoint of this callback is being saved

    def setup(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Become the first callback."""
        callbacks = [callback for callback in trainer.callbacks if callback is not self]  # type: ignore[attr-defined]
        trainer.callbacks = [self, *callbacks]  # type: ignore[attr-defined]
        # Of this run: the last step that was saved, the seconds that it took, and where a stopped one was.
        self._saved_step, self._seconds, self._resumed = -1, 0.0, dict[str, Any]()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Start the clock, and let signals wait."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        self._saved_at = time.monotonic()
        path = self.path(trainer)
        if trainer.logger is None and trainer.ckpt_path is None and trainer.is_global_zero and path.exists():
            path.rename(path.with_stem(f"{path.stem}-{path.stat().st_mtime:.0f}"))  # of another run
        # Not before: Lightning notes and restores the handlers that it finds when it starts to train.
        self._signals.install()
        if isinstance(data := trainer.datamodule, SpeechMotionDataModule):  # type: ignore[attr-defined]
            data.training_state = None  # the loaders have been made
        if self._resumed.get("place") in ("epoch", "end"):
            # Lightning would take the counters of complete epochs for a stop at a validation, and skip a batch.
            trainer.fit_loop.epoch_loop.restarting = False

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:  # noqa: ANN401
        """Save if it is time or if a signal waits; restore the random states at the first step after a resume."""
        if trainer.fast_dev_run:  # type: ignore[attr-defined]
            return
        if self._resumed:
            states = self._resumed.get("random", [])
            if states:
                restore_random_states(states[min(trainer.global_rank, len(states) - 1)])
            trainer.fit_loop.restarting = False  # schedules that follow a metric would miss the first epoch's end
            if self._resumed.get("place") == "step":
                # Lightning has counted a validation that it did not run again.
                trainer.fit_loop.epoch_loop.val_loop.batch_progress.load_state_dict(self._resumed["validated"])
            self._resumed = {}
        if batch_idx % trainer.accumulate_grad_batches:
            return  # gradients of earlier batches are in no checkpoint
        due, number = agreed(trainer, self.is_due(trainer), self._signals.waiting)
        if due or (number and trainer.global_step > self._saved_step):
            self.save(trainer, "step" if batch_idx else "epoch")
        if number:
            self.stop(trainer, number)

    def on_validation_batch_start(
        self,
        trainer: Trainer,
        pl_module: LightningModule,
        batch: Any,  # noqa: ANN401
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        """Stop if a signal waits; nothing is saved here, where averaged weights are in place."""
        if self._signals.installed:
            _, number = agreed(trainer, False, self._signals.waiting)
            if number:
                self.stop(trainer, number)

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """Save the state from which more epochs may follow, before averaged weights replace the trained ones."""
        if not trainer.fast_dev_run:  # type: ignore[attr-defined]
            self.save(trainer, "end")
        self._signals.remove()

    def teardown(self, trainer: Trainer, pl_module: LightningModule, stage: str) -> None:
        """Give the signals back."""
        self._signals.remove()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """Give the signals back."""
        self._signals.remove()

    def is_due(self, trainer: Trainer) -> bool:
        """Whether to save now; before the first step too, so that a full disk is found then."""
        if self._saved_step < 0:
            return True
        if trainer.global_step <= self._saved_step:
            return False
        if self.every_n_steps is not None:
            return trainer.global_step % self.every_n_steps == 0
        return time.monotonic() - self._saved_at >= max(self.every_seconds, self._seconds / SHARE_OF_TIME)

    def save(self, trainer: Trainer, position: str) -> None:
        """Write ``last.ckpt`` at a ``step`` within an epoch, at the first batch of an ``epoch``, or at the ``end``."""
        started = time.monotonic()
        self._place = position
        try:
            trainer.save_checkpoint(trainer.strategy.broadcast(str(self.path(trainer))), weights_only=False)
        finally:
            self._place = None
        self._saved_at = time.monotonic()
        self._seconds = self._saved_at - started
        self._saved_step = trainer.global_step

    def path(self, trainer: Trainer) -> Path:
        """Where ``last.ckpt`` of a run lies; right on the first process."""
        return run_folder(trainer) / LAST

    def stop(self, trainer: Trainer, number: int) -> None:
        """End training on all processes; the exit status is as after the signal itself."""
        self._signals.remove()
        # A process that was started by the first one must not look as if it had failed, or all others are killed.
        status = 0
        if trainer.is_global_zero:
            status = 128 + number
            path, name = self.path(trainer), signal.Signals(number).name
            print(
                f"facediff fit: stopped by {name}; {path} holds the state after step {self._saved_step}, continue with "
                f"the same command, and with --ckpt_path last for `facediff fit`",
                file=sys.stderr,
                flush=True,
            )
            if SLURMEnvironment.detect():
                note_job(path.parents[1])
                if name == "SIGUSR1":
                    requeue()
        raise Stopped(status)

    def on_save_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Add random states and log positions; called on every process and for every checkpoint."""
        rows = [
            logger.rows() if isinstance(logger, ResumableCSVLogger) and trainer.is_global_zero else -1
            for logger in trainer.loggers
        ]
        checkpoint[STATE_KEY] = {
            "place": self._place,
            "random": gathered(trainer, random_states()),
            "rows": rows,
            "versions": logger_versions(trainer) if trainer.is_global_zero else [],
        }
        # Lightning has counted the batch that is about to be trained as "ready", and would take it for trained.
        loop = checkpoint["loops"]["fit_loop"]
        progress = loop["epoch_loop.batch_progress"]
        if self._place in ("step", "epoch"):
            progress["is_last_batch"] = False
            for counter in (progress["total"], progress["current"]):
                counter["ready"] = counter["completed"]
        if self._place == "step":
            # A stop right after a step is one that Lightning knows: it counts the batch as completed when it restarts.
            for counter in (progress["total"], progress["current"]):
                counter["completed"] -= 1
            loop["epoch_loop.state_dict"]["_batches_that_stepped"] -= 1

    def on_load_checkpoint(self, trainer: Trainer, pl_module: LightningModule, checkpoint: dict[str, Any]) -> None:
        """Take the random states for the first step, and drop log rows of steps that will be repeated."""
        if trainer.state.fn != TrainerFn.FITTING:
            return
        loop = checkpoint["loops"]["fit_loop"]
        self._resumed = {
            **checkpoint.get(STATE_KEY, {}),
            "validated": loop["epoch_loop.val_loop.batch_progress"],
        }
        # Lightning restores the loaders' states only where nothing has asked for a loader before. A learning-rate
        # schedule has, to learn the number of steps, and worker processes would hold batches of the wrong epoch.
        states = loop["state_dict"].get("combined_loader", [])
        if states and isinstance(data := trainer.datamodule, SpeechMotionDataModule):  # type: ignore[attr-defined]
            data.training_state = states[0]
        for logger, rows in zip(trainer.loggers, self._resumed.get("rows", ()), strict=False):
            if isinstance(logger, ResumableCSVLogger) and trainer.is_global_zero and rows >= 0:
                logger.keep(rows)
        path = Path(trainer.ckpt_path) if trainer.ckpt_path else None
        is_last = path is not None and path.is_file() and os.path.realpath(path) == os.path.realpath(self.path(trainer))
        if is_last:
            self._saved_step = checkpoint["global_step"]
        for callback in trainer.checkpoint_callbacks:
            if isinstance(callback, ModelCheckpoint):
                continue_bookkeeping(callback, checkpoint, path if is_last else None)


def continue_bookkeeping(callback: ModelCheckpoint, checkpoint: dict[str, Any], last: Path | None) -> None:
    """Let a callback that keeps the best models continue with the existing ones, by its state in a checkpoint.

    ``last`` is the ``last.ckpt`` that is loaded, if its run continues in its folder.
    """
    state, folder = checkpoint.get("callbacks", {}).get(callback.state_key), str(callback.dirpath)
    if state is None:
        return
    before = str(state.get("dirpath", folder))
    if last is not None:  # the folder may have another name by now
        state["dirpath"] = folder

    def moved(path: str) -> str:
        # The callback removes files of these names: none may lie outside its folder.
        name = os.path.normpath(path[len(before) :].lstrip("/\\")) if path.startswith(before) else ".."
        return "" if name.startswith("..") or os.path.isabs(name) else os.path.join(str(state["dirpath"]), name)

    for name in ("best_model_path", "kth_best_model_path", "last_model_path"):
        state[name] = moved(str(state.get(name, "")))
    scores = {moved(str(path)): score for path, score in state.get("best_k_models", {}).items()}
    state["best_k_models"] = {path: score for path, score in scores.items() if path}
    if last is not None:
        # Files that were written after it are written again, under the same names.
        since = last.stat().st_mtime
        again = {str(path) for path in Path(folder).rglob("*.ckpt") if path.stat().st_mtime > since} - set(scores)
        exists = callback.file_exists
        callback.file_exists = lambda filepath, trainer: filepath not in again and exists(filepath, trainer)  # type: ignore


class DeferredSignals:
    """Lets SIGINT, SIGTERM and SIGUSR1 wait until the training step is complete.

    A signal in the middle of a step would leave half-updated weights and optimiser states behind. The same signal once
    more does not wait.
    """

    def __init__(self) -> None:
        self.waiting = 0  # number of the signal that came first
        self._before: dict[int, Any] = {}

    @property
    def installed(self) -> bool:
        """Whether signals wait."""
        return bool(self._before)

    def install(self) -> None:
        """Take over the signals that are not ignored."""
        if threading.current_thread() is not threading.main_thread():
            return
        for name in ("SIGINT", "SIGTERM", "SIGUSR1"):
            number = getattr(signal, name, None)
            if number is not None and signal.getsignal(number) not in (None, signal.SIG_IGN):
                self._before.setdefault(number, signal.getsignal(number))
                signal.signal(number, self._note)

    def remove(self) -> None:
        """Put the previous handlers back."""
        for number, before in self._before.items():
            if signal.getsignal(number) == self._note:
                signal.signal(number, before)
        self._before, self.waiting = {}, 0

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self.waiting == number:
            self.remove()
            if number == signal.SIGINT:
                raise KeyboardInterrupt
            raise Stopped(128 + number)
        self.waiting = self.waiting or number
        if number == signal.SIGINT:
            os.write(2, b"\nfinishing the step and saving; Ctrl-C again stops immediately\n")


def note_job(run: Path) -> None:
    """Note in a run's folder which job of SLURM trained it, which continues it when SLURM starts the job again."""
    # Also after SIGTERM: SLURM itself puts a job that has to make room for another back into the queue.
    with atomic(run / JOB_FILE) as temporary:
        temporary.write_text(job_text(), encoding="utf-8")


def requeue() -> None:
    """Ask SLURM to start this job again."""
    array = os.environ.get("SLURM_ARRAY_JOB_ID")
    job = f"{array}_{os.environ.get('SLURM_ARRAY_TASK_ID')}" if array else os.environ.get("SLURM_JOB_ID", "")
    try:
        failed = subprocess.run(["scontrol", "requeue", job], check=False).returncode  # noqa: S603, S607
    except OSError as error:
        failed = error.errno or 1
    if failed:
        print(f"facediff: `scontrol requeue {job}` failed; start the job again", file=sys.stderr, flush=True)


def requeue_on_signal(trainer: Trainer) -> None:
    """Have SIGUSR1 end a job of SLURM and start it again where :class:`LastCheckpoint` does not take it.

    Lightning would write ``hpc_ckpt_1.ckpt`` into the working folder and go on; under SLURM, every later training in
    that folder begins from this file. The trainer must be made with :func:`slurm_plugins`.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        if trainer.is_global_zero:
            print(f"facediff: stopped by {signal.Signals(number).name}", file=sys.stderr, flush=True)
            requeue()
        raise Stopped(128 + number)

    if SLURMEnvironment.detect() and threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGUSR1, stop)


def slurm_plugins(plugins: object = None) -> list[Any]:
    """The plug-ins of a trainer in a job of SLURM, with which Lightning leaves SIGUSR1 alone."""
    stated = [] if plugins is None else plugins if isinstance(plugins, list) else [plugins]
    for plugin in stated:
        if isinstance(plugin, SLURMEnvironment):
            plugin.auto_requeue = False
    needed = SLURMEnvironment.detect() and not any(isinstance(plugin, ClusterEnvironment) for plugin in stated)
    return [*stated, *([SLURMEnvironment(auto_requeue=False)] if needed else [])]


def agreed(trainer: Trainer, due: bool, number: int) -> tuple[bool, int]:
    """The request of at least one process, known to all: whether to save, and the signal that has come."""
    if trainer.world_size == 1:
        return due, number
    request = torch.tensor([int(due), number], device=trainer.strategy.root_device)
    torch.distributed.all_reduce(request, op=torch.distributed.ReduceOp.MAX)
    return bool(request[0]), int(request[1])


def random_states() -> dict[str, Any]:
    """The states of all generators of this process, as tensors and plain data."""
    kind, keys, position, has_gauss, cached = np.random.get_state(legacy=True)
    version, internal, gauss = random.getstate()
    return {
        "torch": torch.get_rng_state(),
        "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else [],
        "mps": torch.mps.get_rng_state() if torch.backends.mps.is_available() else None,
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
    if states.get("mps") is not None and torch.backends.mps.is_available():
        torch.mps.set_rng_state(states["mps"].cpu())
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
