"""Runs that log to Weights & Biases record what the manual lists."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from facediff.cli.app import main
from tests.cli.conftest import SMALL
from tests.fakes.wandb_run import OfflineRun

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs" / "monitoring.md"
CALLBACKS = """
trainer:
  callbacks+:
    - class_path: lightning.pytorch.callbacks.ThroughputMonitor
      init_args: {batch_size_fn: facediff.data.batch.clips_in}
      dict_kwargs: {window_size: 2}
    - class_path: facediff.callbacks.SamplingPreview
      init_args: {clips: 1, size: 64, seconds: 0.2, steps: 2}
"""


def documented(head: str) -> list[str]:
    """The names in the first column of a table of docs/monitoring.md, by the table's head."""
    lines = DOCS.read_text(encoding="utf-8").splitlines()
    start = lines.index(head) + 2
    end = next(place for place, line in enumerate(lines) if place >= start and not line.startswith("|"))
    return [name for line in lines[start:end] for name in line.split("|")[1].split("`")[1::2]]


LOGGED = documented("| name | meaning | logged |")
LOGGED.remove("train/spoken_sounds")  # of a callback that needs people's recordings
CONFIG = documented("| name | meaning |")


@pytest.fixture(scope="module")
def runs(tiny_root: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[OfflineRun, OfflineRun]:
    """A training and a test."""
    wandb = pytest.importorskip("wandb")
    folder = tmp_path_factory.mktemp("run")
    (folder / "more.yaml").write_text(CALLBACKS)
    data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", "--data.batch_size=2"]
    data += ["--trainer.enable_progress_bar=false"]
    # Where the loss has its term on the upper face.
    vertices = ["--model.motion_space=vertices", "--model.timestep_sampling=uniform"]
    small = [word for word in SMALL if "motion_space" not in word]
    configs = ["experiment/puppet.yaml", "logger/wandb.yaml", "callbacks/dashboard.yaml"]
    words = [f"--config=configs/{config}" for config in configs]
    wandb.finish()  # another test's run in this process
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("WANDB_MODE", "offline")
        patch.chdir(folder)
        assert main(["fit", *words, "--config=more.yaml", *vertices, *data, *small]) == 0
        wandb.finish()
        (checkpoint,) = folder.rglob("best.ckpt")
        words = ["test", f"--ckpt_path={checkpoint}", "--config=configs/logger/wandb.yaml", *data]
        assert main([*words, "--trainer.logger.save_dir=tested"]) == 0
        wandb.finish()
    first, second = sorted(folder.glob("*/wandb/offline-run-*"))
    return OfflineRun(first), OfflineRun(second)


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_every_documented_name_is_recorded(runs: tuple[OfflineRun, OfflineRun]) -> None:
    trained, tested = runs
    found = trained.names | tested.names
    assert len(LOGGED) > 25
    for name in LOGGED:
        pattern = re.sub("<[a-z]+>", "[A-Za-z0-9_]+", name)
        assert any(re.fullmatch(pattern, other) for other in found), name
    for run in (trained, tested):
        assert set(CONFIG) <= set(run.config)
        assert run.config["protocol"] == "paper"
    assert trained.config["config"]["trainer"]["max_epochs"] == 1


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_every_metric_that_is_recorded_is_documented(runs: tuple[OfflineRun, OfflineRun]) -> None:
    trained, tested = runs
    words = {re.sub("<[a-z]+>", "[A-Za-z0-9_]+", name) for name in LOGGED}
    jitter = r"(frame_step|difference_ratio)_\w+"
    words |= {rf"test_[ab]/(still|mean_face|shuffled|usual_style)/(mve|lve|fdd|{jitter})", rf"test_[ab]/{jitter}"}
    words |= {"epoch", "trainer/global_step", "_.*"}
    words |= {r"(train|validate)/(batches|samples|time)", r"validate/device/.*"}  # Lightning's, of no use here
    strange = {name for name in trained.names | tested.names if not any(re.fullmatch(word, name) for word in words)}
    assert not strange


@pytest.mark.slow  # tests/cli/test_lightning.py trains with wandb offline in the quick suite
def test_numbers_and_norms_come_with_every_step(runs: tuple[OfflineRun, OfflineRun]) -> None:
    trained, _ = runs
    steps = [row for row in trained.history if "train/loss" in row]
    assert len(steps) == 4  # eight clips, two a batch
    assert all(row["gradient/norm"] > 0 for row in steps)
    # The callback of the config stands in for the built-in one.
    assert trained.column("gradient/decoder")
