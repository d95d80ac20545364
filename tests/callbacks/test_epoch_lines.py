"""A bar for people who watch, a line for each epoch for files and other programs."""

import logging
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import lightning.pytorch as pl
import pytest
from lightning.pytorch.callbacks import ModelCheckpoint

from facediff.callbacks import EpochLines, RunDescription
from facediff.models import DualPathDiffusion
from tests.cli.conftest import SMALL
from tests.fakes.tiny import Tiny

ROOT = Path(__file__).parents[2]
SHOWN = [word for word in SMALL if "progress_bar" not in word and "max_epochs" not in word]


@pytest.mark.slow
@pytest.mark.parametrize(("words", "bar"), [([], False), (["--trainer.enable_progress_bar=true"], True)])
def test_a_pipe_gets_a_line_for_each_epoch_and_no_bar(
    words: list[str], bar: bool, tiny_root: Path, tmp_path: Path
) -> None:
    data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", f"--trainer.logger.save_dir={tmp_path}"]
    command = [sys.executable, "-m", "facediff", "fit", "--config", "configs/experiment/puppet.yaml", *SHOWN, *data]
    done = subprocess.run(
        [*command, "--trainer.max_epochs=2", *words],
        capture_output=True, text=True, check=False, cwd=ROOT, timeout=240,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    lines = [line for line in done.stderr.splitlines() if re.match(r"epoch \d of 2: train/loss [\d.e+-]+, val/", line)]
    assert len(lines) == (0 if bar else 2)
    assert ("it/s" in done.stdout + done.stderr) == bar


def test_a_line_has_scores_of_its_own_epoch_only(capsys: pytest.CaptureFixture[str]) -> None:
    lines, module = EpochLines(), pl.LightningModule()
    facts = {"is_global_zero": True, "sanity_checking": False, "max_epochs": 3, "current_epoch": 0}
    facts["callback_metrics"] = {"train/loss": 0.5, "val/energy": 0.7}
    trainer: Any = SimpleNamespace(**facts, checkpoint_callbacks=[ModelCheckpoint(monitor="val/energy")])
    lines.on_train_start(trainer, module)
    for validates in (True, False):
        if validates:
            lines.on_validation_end(trainer, module)
        lines.on_train_epoch_end(trainer, module)
        assert ("val/energy 0.7" in capsys.readouterr().err) == validates


@pytest.mark.parametrize(("every", "notes"), [(3, 1), (2, 0)])
def test_a_training_that_does_not_validate_says_so_once(
    every: int,
    notes: int,
    make_model: Callable[..., DualPathDiffusion],
    make_trainer: Callable[..., pl.Trainer],
    tiny: Tiny,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.setattr(logging.getLogger("lightning.pytorch"), "handlers", [caplog.handler])
    trainer = make_trainer(
        max_epochs=2, check_val_every_n_epoch=every, limit_train_batches=1, callbacks=[RunDescription()]
    )
    trainer.fit(make_model(), datamodule=tiny)
    assert caplog.text.count("does not validate") == notes
