"""A project of LightningCLI runs with ``facediff`` in place of its script: words, configs and Lightning's callbacks."""

from __future__ import annotations

import csv
import sys
from pathlib import Path

import lightning.pytorch as pl
import pytest
import torch
import yaml
from lightning.pytorch.cli import LightningCLI

from facediff.cli.app import main
from facediff.data import SpeechMotionDataModule
from facediff.models import AnimationModel, DualPathDiffusion

CALLBACKS = """
from lightning.pytorch.callbacks import BaseFinetuning


class Thaw(BaseFinetuning):
    def freeze_before_training(self, pl_module):
        self.freeze(pl_module.network.decoder)

    def finetune_function(self, pl_module, epoch, optimizer):
        if epoch == 1:
            self.unfreeze_and_add_param_group(pl_module.network.decoder, optimizer)
"""
LOGGERS = ["CSVLogger", {"class_path": "lightning.pytorch.loggers.CSVLogger", "init_args": {"save_dir": "more"}}]


@pytest.fixture
def project(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a config as LightningCLI writes it, and a file of callbacks."""
    sizes = {"n_vertices": 24, "identities": ["A", "B"], "frame_rate": 25.0}
    best = {"class_path": "ModelCheckpoint", "init_args": {"monitor": "val/loss", "filename": "lowest-{epoch}"}}
    config = {
        "seed_everything": 3,
        "model": {
            "class_path": "facediff.models.DualPathDiffusion",
            "init_args": {"dim": 16, "diffusion_steps": 8},
        },
        "data": {"class_path": "tests.fakes.tiny.Tiny", "init_args": {"root": str(tiny_root), "batch_size": 4}},
        "trainer": {
            "accelerator": "cpu", "devices": 1, "max_epochs": 2, "logger": LOGGERS[1:], "callbacks": [best],
            "enable_progress_bar": False, "enable_model_summary": False, "log_every_n_steps": 1,
        },
    }  # fmt: skip
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    (tmp_path / "sizes.yaml").write_text(yaml.safe_dump({"model": {"init_args": sizes}}))
    (tmp_path / "my_callbacks.py").write_text(CALLBACKS)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "my_callbacks", raising=False)
    return tmp_path


WORDS = [
    *("--optimizer=SGD", "--optimizer.lr=0.01", "--lr_scheduler=StepLR", "--lr_scheduler.step_size=1"),
    *("--trainer.callbacks+=Timer", "--trainer.callbacks.duration=00:01:00:00"),
    *("--trainer.profiler=SimpleProfiler", "--trainer.profiler.dirpath=.", "--trainer.profiler.filename=profile"),
]


@pytest.mark.filterwarnings("ignore")
def test_the_words_and_the_config_of_a_plain_project_run(
    project: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(SystemExit):
        main(["fit", "--config", "config.yaml", *WORDS, "--print_config"])
    printed = yaml.safe_load(capsys.readouterr().out)
    monkeypatch.setattr(sys, "argv", ["script"])
    plain = LightningCLI(
        AnimationModel, SpeechMotionDataModule, subclass_mode_model=True, subclass_mode_data=True, run=False,
        args=["--config", "config.yaml", "--config", "sizes.yaml", *WORDS],
    )  # fmt: skip
    parsed = plain.config.as_dict()
    assert printed["optimizer"] == parsed["optimizer"]
    assert printed["lr_scheduler"] == parsed["lr_scheduler"]
    assert [c["class_path"] for c in printed["trainer"]["callbacks"]] == [
        callback.class_path for callback in plain.config.trainer.callbacks
    ]
    assert type(plain.model) is DualPathDiffusion
    thaw = ["--trainer.callbacks+=my_callbacks.Thaw"]
    assert main(["fit", "--config", "config.yaml", *WORDS, *thaw]) == 0
    assert (project / "fit-profile.txt").is_file()
    run = project / "more" / "config" / "version_0"
    last = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    assert [group["momentum"] for group in last["optimizer_states"][0]["param_groups"]] == [0.0, 0.0]
    assert last["lr_schedulers"][0]["description"]["class_path"] == "torch.optim.lr_scheduler.StepLR"
    assert yaml.safe_load((run / "config.yaml").read_text())["optimizer"] == printed["optimizer"]
    assert main(["test", "--config", "config.yaml", "--ckpt_path", "best"]) == 0
    (scores,) = project.rglob("test_scores.csv")
    assert csv.DictReader(scores.read_text().splitlines()).fieldnames


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("interpolated", [[], ["--config=interpolated.yaml"]])
def test_stochastic_weight_averaging_runs_with_and_without_interpolation(
    interpolated: list[str], project: Path
) -> None:
    (project / "interpolated.yaml").write_text("model: {init_args: {warmup_steps: '${trainer.max_epochs}'}}")
    words = ["--trainer.callbacks+=StochasticWeightAveraging", "--trainer.callbacks.swa_lrs=0.01", *interpolated]
    assert main(["fit", "--config", "config.yaml", "--trainer.max_epochs=3", *words]) == 0


@pytest.mark.filterwarnings("ignore")
def test_a_resume_applies_options_or_refuses_and_leaves_the_config(
    project: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["fit", "--config", "config.yaml", "--model.learning_rate=1e-3"]
    assert main([*words, "--trainer.max_epochs=1"]) == 0
    run = project / "more" / "config" / "version_0"
    before = (run / "config.yaml").read_bytes()
    for change in (["--lr_scheduler=StepLR", "--lr_scheduler.step_size=1"], ["--optimizer=SGD"]):
        capsys.readouterr()
        assert main([*words, "--ckpt_path=last", *change]) == 2
        assert change[0].partition("=")[0] in capsys.readouterr().err
        assert (run / "config.yaml").read_bytes() == before
    assert main([*words[:3], "--ckpt_path=last", "--model.learning_rate=0.5", "--model.weight_decay=0.25"]) == 0
    (group,) = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)["optimizer_states"][0]["param_groups"]
    assert (group["lr"], group["weight_decay"]) == (0.5, 0.25)
    assert yaml.safe_load((run / "config.yaml").read_text())["model"]["init_args"]["learning_rate"] == 0.5


@pytest.mark.filterwarnings("ignore")
def test_plain_loaders_of_batches_train_and_predict_a_trained_model(
    project: Path, tiny_root: Path, make_trainer: object
) -> None:
    from facediff.callbacks import defaults
    from facediff.models import load_model
    from tests.fakes.tiny import Tiny

    assert main(["fit", "--config", "config.yaml", "--trainer.max_epochs=1"]) == 0
    model = load_model(project / "more/config/version_0/checkpoints/last.ckpt")
    data = Tiny(root=str(tiny_root), batch_size=4)
    quiet = {"logger": False, "enable_progress_bar": False, "enable_model_summary": False, "accelerator": "cpu"}
    trainer = pl.Trainer(max_epochs=1, callbacks=defaults(), **quiet)
    trainer.fit(model, data.train_dataloader(), data.val_dataloader())
    assert "val/loss" in trainer.callback_metrics
    assert len(pl.Trainer(**quiet).predict(model, data.predict_dataloader())) > 0


BROKEN = {
    "syntax": ("\nclass Mine(object)\n    pass\n", "line 2: SyntaxError: expected ':'"),
    "import": ("\nimport no_such_package\n", "line 2: ModuleNotFoundError: No module named 'no_such_package'"),
    "name": ("x = 1\ny = undefined\n", "line 2: NameError"),
}


@pytest.mark.parametrize("kind", BROKEN)
def test_an_error_in_a_file_of_the_users_comes_with_file_line_and_reason(
    kind: str, project: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    text, reason = BROKEN[kind]
    (project / "broken.py").write_text(text)
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    (project / "own.yaml").write_text("trainer: {callbacks+: [{class_path: broken.Mine}]}\n")
    for words in (
        ["--model=broken.Mine"],
        ["--model.decoder=broken.Mine"],
        ["--data=broken.Mine"],
        ["--trainer.callbacks+=broken.Mine"],
        ["--config", "own.yaml"],
    ):
        assert main(["fit", "--config", "config.yaml", *words]) == 2
        error = capsys.readouterr().err
        assert "broken.py" in error, words
        assert reason in error, words
