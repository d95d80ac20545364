"""The folder of a run: what killed runs have left next to it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from lightning.pytorch import Trainer
from lightning.pytorch.loggers import CSVLogger

from facediff.callbacks.runs import locked_run
from facediff.utils import files


def test_what_a_run_that_was_killed_in_its_first_save_left_is_swept(tmp_path: Path) -> None:
    checkpoints = tmp_path / "small" / "version_0" / "checkpoints"
    checkpoints.mkdir(parents=True)
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    own = files._partial(checkpoints / "last.ckpt", ".ckpt")
    left = own.with_name(own.name.replace(f"-{own.name.split('-')[2]}-", f"-{ended.pid}-"))
    for path in (own, left):
        path.write_bytes(b"x")
    trainer = Trainer(logger=CSVLogger(tmp_path, name="small"), accelerator="cpu", enable_progress_bar=False)
    with locked_run(trainer, new=True):
        assert [*checkpoints.iterdir()] == [own]  # this process is at work
