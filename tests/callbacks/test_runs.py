"""The folder of a run: what killed runs have left next to it, and the job of SLURM that continues it."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger

from facediff.callbacks import LastCheckpoint, checkpoints
from facediff.callbacks.runs import LOCK, continued_run, entered_run, find_checkpoint, run_folder
from facediff.utils import files
from facediff.utils.files import locked


def test_what_a_run_that_was_killed_in_its_first_save_left_is_swept(tmp_path: Path) -> None:
    checkpoints = tmp_path / "small" / "version_0" / "checkpoints"
    checkpoints.mkdir(parents=True)
    for place in (checkpoints / "last.ckpt", checkpoints.parent / "config.yaml"):
        files._partial(place).mkdir()
    (checkpoints.parent / LOCK).write_bytes(b"x")
    trainer = Trainer(logger=CSVLogger(tmp_path, name="small"), accelerator="cpu", enable_progress_bar=False)
    with entered_run(trainer, []):
        assert [*checkpoints.parent.rglob("*")] == [checkpoints]


def test_the_lock_of_a_run_that_goes_on_stays(tmp_path: Path) -> None:
    others = tmp_path / "small" / "version_0" / LOCK
    with locked(others, "facediff fit"):
        trainer = Trainer(logger=CSVLogger(tmp_path, name="small"), accelerator="cpu", enable_progress_bar=False)
        with entered_run(trainer, []):
            assert others.is_file()
            assert (tmp_path / "small" / "version_1" / LOCK).is_file()


def test_a_folder_next_to_a_run_that_no_run_has_locked_is_left_alone(tmp_path: Path) -> None:
    half = files._partial(tmp_path / "films" / "hello.mp4")  # of a command that is at work
    half.mkdir(parents=True)
    trainer = Trainer(logger=CSVLogger(tmp_path, name=""), accelerator="cpu", enable_progress_bar=False)
    with entered_run(trainer, []):
        assert run_folder(trainer).parent == tmp_path
        assert [*half.parent.iterdir()] == [half]


@pytest.mark.parametrize(("name", "logs"), [("SIGTERM", True), ("SIGUSR1", True), ("SIGUSR1", False)])
def test_a_job_of_slurm_that_was_stopped_continues_its_run(
    name: str, logs: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = {"JOB_ID": 77, "JOB_NAME": "facediff", "NTASKS": 1, "PROCID": 0, "LOCALID": 0, "NODEID": 0}
    for variable, value in job.items():
        monkeypatch.setenv(f"SLURM_{variable}", str(value))
    asked: list[None] = []
    monkeypatch.setattr(checkpoints, "requeue", lambda: asked.append(None))
    logger = CSVLogger(tmp_path, name="small") if logs else False
    options = {"accelerator": "cpu", "devices": 1, "enable_progress_bar": False, "default_root_dir": tmp_path}
    trainer = Trainer(logger=logger, **options)
    last = LastCheckpoint()
    last.path(trainer).parent.mkdir(parents=True)
    with pytest.raises(SystemExit):
        last.stop(trainer, signal.Signals[name])
    assert len(asked) == (name == "SIGUSR1")  # a job that makes room for another is requeued by SLURM itself
    assert find_checkpoint(trainer, [], None) is None
    monkeypatch.setenv("SLURM_RESTART_COUNT", "1")
    assert find_checkpoint(trainer, [], None) == last.path(trainer)
    monkeypatch.setattr("sys.argv", ["facediff", "fit", "--model=another"])  # which the same job ran before
    assert find_checkpoint(trainer, [], None) is None


@pytest.mark.parametrize(
    ("place", "version", "name", "continues"),
    [
        ([], None, "small", True),
        (["--trainer.logger.version=0"], 0, "small", True),
        (["--trainer.logger.version=5"], 5, "small", False),
        (["--name", "small"], None, "small", True),
        (["--name", "other"], None, "other", False),
    ],
)
def test_a_run_continues_unless_the_command_line_names_another_place(
    place: list[str], version: int | None, name: str, continues: bool, tmp_path: Path
) -> None:
    options = {"save_dir": str(tmp_path), "name": name, "version": version}
    entries = [{"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": options}]
    trainer = Trainer(logger=CSVLogger(**options), accelerator="cpu", devices=1, enable_progress_bar=False)
    path = tmp_path / "small" / "version_0" / "checkpoints" / "last.ckpt"
    run = continued_run(trainer, entries, path, {"global_step": 3}, place)
    assert (run is not None) == continues
    with entered_run(trainer, entries, run, {"global_step": 3}):
        expected = path.parents[1] if continues else tmp_path / name / f"version_{version or 0}"
        assert run_folder(trainer) == expected
