"""A bar for people who watch, a line for each epoch for files and other programs."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.cli.conftest import SMALL

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
