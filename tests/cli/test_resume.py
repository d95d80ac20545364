"""Training that was stopped continues with ``--ckpt_path last``, in the folder of its run."""

from __future__ import annotations

import csv
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import pytest
import torch
from lightning.pytorch.callbacks import ModelCheckpoint

from facediff.callbacks import runs
from facediff.callbacks.checkpoints import AtomicCheckpointIO
from facediff.callbacks.runs import LOCK
from facediff.models import DualPathDiffusion
from facediff.utils.files import LockedError, locked
from tests.cli.conftest import SMALL

Fit = Callable[..., int]
EVERY_STEP = ["--trainer.callbacks+=facediff.callbacks.LastCheckpoint", "--trainer.callbacks.every_n_steps=1"]
LONGER = ["--trainer.max_epochs=3", "--data.batch_size=2", "--trainer.limit_val_batches=1", *EVERY_STEP]
CLOCK = ("/time", "/seconds", "per_sec", "device/", "train/batches", "train/samples")


def curve(run: Path) -> list[dict[str, str]]:
    """What was logged, without times."""
    with (run / "metrics.csv").open() as stream:
        rows = [
            {k: v for k, v in row.items() if v and not any(t in k for t in CLOCK)} for row in csv.DictReader(stream)
        ]
    return [row for row in rows if row.keys() - {"step"}]


def weights(run: Path) -> dict[str, list[float]]:
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    parts = {**content["state_dict"], **{f"own {k}": v for k, v in content["current_model_state"].items()}}
    return {name: tensor.tolist() for name, tensor in parts.items()}


def files(run: Path) -> list[str]:
    return sorted(path.relative_to(run).as_posix() for path in run.rglob("*"))


def stop_at(step: int, monkeypatch: pytest.MonkeyPatch, number: int | None = None) -> None:
    """Let a signal come, or an error, in the middle of a step."""
    step_of = DualPathDiffusion.training_step

    def training_step(self: DualPathDiffusion, *words: object) -> torch.Tensor:
        if self.trainer.global_step == step:
            if number is None:
                raise RuntimeError("killed")
            os.kill(os.getpid(), number)
        return step_of(self, *words)  # type: ignore[arg-type]

    monkeypatch.setattr(DualPathDiffusion, "training_step", training_step)


@pytest.fixture(scope="module")
def whole(fit: Fit, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("whole")
    assert fit(*LONGER, f"--trainer.logger.save_dir={folder}") == 0
    return folder / "puppet" / "version_0"


@pytest.mark.slow
def test_a_run_stopped_by_an_error_and_two_signals_continues_in_its_folder(
    fit: Fit, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*LONGER, f"--trainer.logger.save_dir={tmp_path}"]
    with monkeypatch.context() as patched:
        stop_at(5, patched)
        with pytest.raises(RuntimeError, match="killed"):
            fit(*words)
    for step, number in ((6, signal.SIGTERM), (9, signal.SIGINT)):
        with monkeypatch.context() as patched:
            stop_at(step, patched, number)
            with pytest.raises(SystemExit) as stop:
                fit(*words, "--ckpt_path=last")
        assert stop.value.code == 128 + number
        assert "--ckpt_path last" in capsys.readouterr().err
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    run = tmp_path / "puppet" / "version_0"
    path = run / "checkpoints" / "last.ckpt"
    assert fit(*LONGER, f"--trainer.logger.save_dir={tmp_path}", f"--ckpt_path={path}") == 0
    assert curve(run) == curve(whole)
    assert weights(run) == weights(whole)
    assert files(run) == files(whole)
    assert "ckpt_path: null" in (run / "config.yaml").read_text()


@pytest.mark.slow
def test_a_run_without_a_checkpoint_begins_again_and_no_run_is_an_error(
    fit: Fit, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [*LONGER, f"--trainer.logger.save_dir={tmp_path}", "--ckpt_path", "last"]
    assert fit(*words) == 2
    assert "--ckpt_path last" in capsys.readouterr().err
    run = tmp_path / "puppet" / "version_0"
    run.mkdir(parents=True)
    shutil.copy(whole / "config.yaml", run)
    assert fit(*words) == 0
    assert curve(run) == curve(whole)
    # A newer run without a checkpoint: neither is meant for sure.
    newer = tmp_path / "puppet" / "version_1"
    newer.mkdir()
    (newer / "config.yaml").write_text("")
    os.utime(newer, (time.time() + 60,) * 2)
    assert fit(*words) == 2
    assert str(run / "checkpoints" / "last.ckpt") in capsys.readouterr().err


@pytest.mark.filterwarnings("ignore:The dirpath has changed")
@pytest.mark.slow
def test_the_last_run_is_one_of_the_same_experiment(
    fit: Fit, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [f"--trainer.logger.save_dir={tmp_path}", "--trainer.max_epochs=2"]
    assert fit(words[0], "--name=first") == 0
    assert fit(*words, "--name=second", "--ckpt_path=last") == 2
    assert str(tmp_path / "second") in capsys.readouterr().err
    assert fit(*words, "--name=first", "--ckpt_path=last") == 0
    last = tmp_path / "first" / "version_0" / "checkpoints" / "last.ckpt"
    assert torch.load(last, weights_only=True)["epoch"] == 2
    assert fit(words[0], "--trainer.max_epochs=3", "--name=second", f"--ckpt_path={last}") == 0
    assert [path.relative_to(tmp_path).as_posix() for path in sorted(tmp_path.glob("*/*"))] == [
        "first/version_0",
        "second/version_0",
    ]


def test_a_full_disk_is_one_sentence_and_leaves_the_checkpoint(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save, saved = AtomicCheckpointIO.save_checkpoint, []

    def full(self: AtomicCheckpointIO, checkpoint: dict[str, object], path: str, storage_options: object) -> None:
        if len(saved) == 3:
            monkeypatch.setattr(os, "fsync", no_room)
        saved.append(path)
        save(self, checkpoint, path)

    def no_room(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(AtomicCheckpointIO, "save_checkpoint", full)
    words = [*LONGER, f"--trainer.logger.save_dir={tmp_path}"]
    assert fit(*words) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("facediff: error:")
    assert ".ckpt" in error
    run = tmp_path / "puppet" / "version_0"
    assert torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["global_step"] >= 2
    assert not [path for path in run.rglob("*") if "partial" in path.name]


@pytest.mark.slow
def test_a_run_that_another_process_trains_is_left_alone(
    fit: Fit, whole: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    run = tmp_path / "puppet" / "version_7"
    shutil.copytree(whole, run)
    place = [f"--trainer.logger.save_dir={tmp_path}", "--trainer.logger.version=7"]
    before = {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()}
    for more in (["--ckpt_path=last"], []):
        with locked(run / LOCK, "facediff fit"):
            assert fit(*LONGER, *place, *more) == 2
        assert re.search(r"version_7: another `facediff fit` \(process \d+ on", capsys.readouterr().err)
    assert {path: path.stat().st_mtime_ns for path in run.rglob("*") if path.is_file()} == before

    def taken(path: Path, command: str) -> AbstractContextManager[None]:
        if path.parent.name == "version_8":  # another process has chosen the same number, and was quicker
            path.parent.mkdir(exist_ok=True)
            raise LockedError("taken")
        return locked(path, command)

    monkeypatch.setattr(runs, "locked", taken)
    assert fit("--trainer.max_steps=1", place[0]) == 0
    assert files(tmp_path / "puppet" / "version_8") == []
    assert LOCK not in files(tmp_path / "puppet" / "version_9")
    assert (tmp_path / "puppet" / "version_9" / "checkpoints" / "last.ckpt").is_file()


@pytest.mark.slow
def test_a_fast_dev_run_leaves_nothing(fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for logger in ("logger.save_dir=runs", "logger=false"):  # configs watch the learning rate, which needs a logger
        assert fit("--trainer.fast_dev_run=1", f"--trainer.{logger}") == 0
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_checkpoints_can_be_switched_off(fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert fit("--trainer.enable_checkpointing=false", "--trainer.callbacks=[]", "--trainer.logger.save_dir=runs") == 0
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.slow
def test_a_users_own_callbacks_and_loggers_come_with_a_last_checkpoint(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert fit("--trainer.callbacks=[]", "--trainer.logger=false") == 0
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["epoch"] == 1
    assert fit("--trainer.callbacks=[]", "--trainer.logger=false", "--trainer.max_epochs=2", "--ckpt_path=last") == 0
    assert torch.load(tmp_path / "checkpoints" / "last.ckpt", weights_only=True)["epoch"] == 2


@pytest.mark.slow
def test_no_checkpoint_makes_training_remove_files_elsewhere(whole: Path, fit: Fit, tmp_path: Path) -> None:
    run = tmp_path / "puppet" / "version_0"
    shutil.copytree(whole, run)
    mine = tmp_path / "mine.ckpt"
    mine.write_text("mine")
    path = run / "checkpoints" / "last.ckpt"
    content = torch.load(path, weights_only=True)
    for name, state in content["callbacks"].items():
        if name.startswith(ModelCheckpoint.__name__):
            worst = torch.tensor(1e9)
            state |= {
                "best_k_models": {str(mine): worst},
                "kth_best_model_path": str(mine),
                "best_model_path": str(mine),
            }
            state |= {"best_model_score": worst, "kth_value": worst}
    torch.save(content, path)
    words = [*LONGER[1:], "--trainer.max_epochs=4", f"--trainer.logger.save_dir={tmp_path}"]
    assert fit(*words, "--ckpt_path=last") == 0
    assert mine.read_text() == "mine"


@pytest.fixture
def start(tiny_root: Path) -> Iterator[Callable[..., subprocess.Popen[str]]]:
    running: list[subprocess.Popen[str]] = []

    def run(*words: str) -> subprocess.Popen[str]:
        data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}"]
        given = {word.partition("=")[0] for word in words}
        usual = [word for word in [*data, *SMALL] if word.partition("=")[0] not in given]
        command = [sys.executable, "-m", "facediff", "fit", "--config", "configs/experiment/puppet.yaml", *usual]
        root = Path(__file__).parents[2]
        environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
        pipe = subprocess.PIPE
        running.append(
            subprocess.Popen([*command, *words], cwd=root, env=environment, stdout=pipe, stderr=pipe, text=True)
        )
        return running[-1]

    yield run
    for process in running:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
@pytest.mark.parametrize("processes", [1, 2])
def test_a_killed_process_loses_nothing(
    number: int, processes: int, start: Callable[..., subprocess.Popen[str]], tmp_path: Path
) -> None:
    words = [*LONGER[1:], "--trainer.max_epochs=8"]
    if processes > 1:
        words += [f"--trainer.devices={processes}", "--trainer.strategy=ddp"]
    assert start(*words, f"--trainer.logger.save_dir={tmp_path / 'whole'}").wait(300) == 0
    mine = [*words, f"--trainer.logger.save_dir={tmp_path / 'mine'}"]
    process, run = start(*mine), tmp_path / "mine" / "puppet" / "version_0"
    seen, limit = set(), time.monotonic() + 200
    while len(seen) < 2 and process.poll() is None and time.monotonic() < limit:
        if (run / "checkpoints" / "last.ckpt").exists():
            seen.add((run / "checkpoints" / "last.ckpt").stat().st_mtime_ns)
        time.sleep(0.002)
    process.send_signal(number)
    assert process.wait(120) == (-number if number == signal.SIGKILL else 128 + number)
    assert start(*mine, "--ckpt_path=last").wait(300) == 0
    other = tmp_path / "whole" / "puppet" / "version_0"
    assert curve(run) == curve(other)
    assert weights(run) == weights(other)
    assert files(run) == files(other)
