"""fit, validate, test and predict from the command line."""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import yaml

from facediff.callbacks import checkpoints
from facediff.cli.app import main
from facediff.cli.lightning import words_of_checkpoint
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError
from facediff.models import DualPathDiffusion, load_model
from facediff.models.pretrained import DATA_OPTIONS_KEY
from tests.cli.conftest import SMALL
from tests.fakes import processes, tiny
from tests.fakes.parsing import printed_config

Fit = Callable[..., int]
CONFIGS = Path(__file__).parents[2] / "configs"


def test_a_decoder_is_swapped_by_name(fitted: Path, checkpoint: Path) -> None:
    config = yaml.safe_load((fitted / "config.yaml").read_text())
    decoder = config["model"]["init_args"]["decoder"]
    assert decoder["class_path"] == "facediff.models.decoders.GruDecoder"
    assert decoder["init_args"]["num_layers"] == 1
    assert type(load_model(checkpoint).network.decoder).__name__ == "GruDecoder"
    assert (fitted / "metrics.csv").is_file()


@pytest.mark.slow
def test_a_saved_config_runs_again(fitted: Path, fit: Fit, tmp_path: Path) -> None:
    status = fit(f"--trainer.logger.save_dir={tmp_path}", config=str(fitted / "config.yaml"))
    assert status == 0
    again = yaml.safe_load((tmp_path / "puppet" / "version_0" / "config.yaml").read_text())
    first = yaml.safe_load((fitted / "config.yaml").read_text())
    assert again["model"] == first["model"]
    assert again["data"] == first["data"]


@pytest.mark.parametrize("command", ["test", "fit"])
def test_a_signal_of_slurm_outside_of_training_requeues_and_leaves_no_state(
    command: str, checkpoint: Path, fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Lightning's hpc_ckpt_1.ckpt would be what every later training in this folder begins from."""
    monkeypatch.chdir(tmp_path)
    job = {"JOB_ID": 77, "JOB_NAME": "facediff", "NTASKS": 1, "PROCID": 0, "LOCALID": 0, "NODEID": 0}
    for variable, value in job.items():
        monkeypatch.setenv(f"SLURM_{variable}", str(value))
    asked: list[None] = []
    monkeypatch.setattr(checkpoints, "requeue", lambda: asked.append(None))
    step = "test_step" if command == "test" else "validation_step"  # before training, to see that it works
    monkeypatch.setattr(DualPathDiffusion, step, lambda *_: os.kill(os.getpid(), signal.SIGUSR1))
    with pytest.raises(SystemExit) as stop:
        main(["test", "--ckpt_path", str(checkpoint)]) if command == "test" else fit("--trainer.logger=CSVLogger")
    assert stop.value.code == 128 + signal.SIGUSR1
    assert len(asked) == 1
    assert not list(tmp_path.rglob("*.ckpt"))


def test_test_takes_everything_from_the_checkpoint(
    checkpoint: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    caplog: pytest.LogCaptureFixture,
) -> None:
    monkeypatch.chdir(tmp_path)
    # Lightning's messages do not go to the root of the loggers.
    monkeypatch.setattr(logging.getLogger("lightning.pytorch"), "handlers", [caplog.handler])
    assert main(["test", "--ckpt_path", str(checkpoint), "--trainer.enable_progress_bar=false"]) == 0
    assert "protocol paper" in capsys.readouterr().out
    assert "GPU available" in caplog.text
    assert "try installing" not in caplog.text
    (table,) = tmp_path.glob("runs/test/version_0/test_scores.csv")
    # Which training run the scores are of: the config's seed, the file, and the decoder that the run was started with.
    for row in csv.DictReader(table.read_text().splitlines()):
        assert (row["seed"], row["checkpoint"]) == ("0", hashlib.sha256(checkpoint.read_bytes()).hexdigest())
        assert "DualPathDiffusion" in row["components"]
        assert "decoder=gru" in row["components"]
    report = json.loads((table.parent / "test_report.json").read_text())
    assert report["provenance"] == json.loads((table.parent / "provenance.json").read_text())
    assert report["columns"]["lve"] == {"pooling": "frames", "better": "lower"}
    assert len(report["sequences"]) == 30


@pytest.mark.slow
def test_a_config_of_the_users_is_not_overwritten(
    checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run without a logger has no folder of its own to write its config to."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "config.yaml").write_text("mine")
    words = ["validate", f"--ckpt_path={checkpoint}", "--trainer.enable_progress_bar=false", "--trainer.logger=false"]
    assert main(words) == 0
    assert (tmp_path / "config.yaml").read_text() == "mine"
    assert main([*words, "--trainer.default_root_dir=there"]) == 0
    assert "seed_everything" in (tmp_path / "there" / "config.yaml").read_text()


def test_predict_writes_files(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file of the data module adds to the checkpoint's options, which say where the corpus is."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "part.yaml").write_text("class_path: tests.fakes.tiny.Tiny\ninit_args: {batch_size: 3}\n")
    words = ["predict", f"--ckpt_path={checkpoint}", "--trainer.enable_progress_bar=false", "--model.sampler.steps=1"]
    monkeypatch.setitem(sys.modules, "elsewhere", tiny)
    places = ("tests.fakes.tiny.", "", "elsewhere.")
    options = [words_of_checkpoint("test", checkpoint, [f"--data={place}Tiny"]) for place in places]
    assert options[0] == options[1] == options[2] != []
    with pytest.raises(FaceDiffError, match="--data elsewhere.Large: cannot be imported"):
        words_of_checkpoint("test", checkpoint, ["--data=elsewhere.Large"])
    assert main([*words, "--data=part.yaml"]) == 0
    assert "batch_size: 3" in (tmp_path / "runs/predict/version_0/config.yaml").read_text()
    files = sorted(tmp_path.glob("runs/predict/version_0/predictions/*.npy"))
    assert [f.name for f in files] == [f"{s}_e0{n}_condition_{s}.npy" for s in "AB" for n in (6, 7)]
    assert np.load(files[0]).shape[1] == 72


def test_a_component_of_the_working_folder_is_read_where_its_user_names_it(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "my_decoder", raising=False)
    code = "from facediff.models.decoders import GruDecoder\n\n\nclass Mine(GruDecoder):\n    pass\n"
    (tmp_path / "my_decoder.py").write_text(code)
    named = "--model.decoder=my_decoder.Mine"
    assert fit(named, "--model.decoder.num_layers=1", "--name=mine") == 0
    (path,) = tmp_path.glob("runs/mine/version_0/checkpoints/last.ckpt")
    del sys.modules["my_decoder"]
    with pytest.raises(FaceDiffError, match=f"add {named} to"):
        words_of_checkpoint("test", path, [])
    with pytest.raises(FaceDiffError, match="--model.decoder=gru"):
        words_of_checkpoint("test", path, [named, "--model.decoder=gru"])
    del sys.modules["my_decoder"]
    assert main(["validate", f"--ckpt_path={path}", named, "--trainer.enable_progress_bar=false"]) == 0
    written = yaml.safe_load((tmp_path / "runs/validate/version_0/config.yaml").read_text())
    assert written["model"]["init_args"]["decoder"]["init_args"]["num_layers"] == 1


@pytest.mark.slow
def test_the_last_checkpoint_is_the_newest_runs(
    fitted: Path, tiny_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}"]
    words = [
        "--config",
        str(fitted / "config.yaml"),
        *data,
        f"--trainer.logger.save_dir={tmp_path}",
        "--ckpt_path=last",
    ]
    assert main(["test", *words]) == 2
    assert "--ckpt_path last" in capsys.readouterr().err.splitlines()[-1]
    run = tmp_path / "puppet" / "version_0"
    run.mkdir(parents=True)
    (run / "config.yaml").write_text("model: begun\n")
    assert main(["predict", *words]) == 2
    assert str(run / "checkpoints" / "last.ckpt") in capsys.readouterr().err.splitlines()[-1]
    shutil.rmtree(run)
    shutil.copytree(fitted, run)
    for version in (1, 2):  # a run of scoring is not taken for one of training
        assert main(["validate", *words]) == 0
        os.utime(tmp_path / "puppet" / f"version_{version}", (time.time() + 60,) * 2)


def test_a_wrong_name_lists_the_right_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Of models, corpora and components, on the command line and in a file."""
    (tmp_path / "own.yaml").write_text("model: {init_args: {decoder: {class_path: grru}}}\n")
    for words, sentence in (
        (["--model.decoder=grru"], 'there is no decoder "grru": did you mean "gru"? known are gru'),
        (["--config", str(tmp_path / "own.yaml")], 'there is no decoder "grru": did you mean "gru"?'),
        (["--model=DualPathDifusion"], 'did you mean "DualPathDiffusion"?'),
        (["--data=Pupet"], 'did you mean "Puppet"?'),
    ):
        assert main(["fit", "--config", "configs/experiment/puppet.yaml", *words]) == 2
        error = capsys.readouterr().err
        assert sentence in error
        assert len(error.splitlines()) == 1


MISTAKES = (
    ("fit --config nowhere.yaml", "--config nowhere.yaml"),
    ("fit --config=configs/experiment/pupet.yaml", '"configs/experiment/puppet.yaml"'),
    ("test --ckpt_path nowhere.ckpt", "--ckpt_path nowhere.ckpt"),
    ("test", "--ckpt_path CHECKPOINT"),
    ("test --ckpt_path last", "--ckpt_path last: the config says"),
    ("predict --ckpt_path best", "--ckpt_path best: the config says"),
    ("fit --config configs/experiment/puppet.yaml --ckpt_path=registry", "--ckpt_path registry"),
    ("fit", "--config FILE"),
)


def test_help_and_mistakes_in_the_words_are_printed_without_importing_torch() -> None:
    program = (
        "import sys\nfrom facediff.cli.app import main\n"
        "assert [main(words.split()) for words in sys.argv[1:]] == [2] * (len(sys.argv) - 1)\n"
        "assert main(['fit', '--help']) == 0\nassert not {'torch', 'lightning', 'jsonargparse'} & set(sys.modules)"
    )
    command = [sys.executable, "-c", program, *(words for words, _ in MISTAKES)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "--optimizer" in done.stdout
    for (_, named), line in zip(MISTAKES, done.stderr.splitlines(), strict=True):
        assert named in line


def test_help_of_a_component(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["fit", "--config", "configs/experiment/puppet.yaml", "--model.decoder.help=gru"])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert "num_layers" in text
    assert "style_dim" not in text


@pytest.mark.parametrize(
    "words", [["--model.sampler=ddpm", "--model.decoder=gru"], ["--model.sampler", "ddpm", "--model.decoder", "gru"]]
)
def test_a_component_chosen_by_name_starts_from_its_own_defaults(words: list[str]) -> None:
    words = ["--config", "configs/experiment/puppet.yaml", *words, "--model.decoder.dropout=0.3"]
    model = printed_config(*words)["model"]["init_args"]
    assert model["sampler"]["init_args"]["steps"] is None  # and not the five of dpm_solver that stood there
    assert model["decoder"]["init_args"] == {"num_layers": 2, "bidirectional": True, "dropout": 0.3}


EXPERIMENTS = sorted(path.name for path in (CONFIGS / "experiment").glob("*.yaml"))
QUICK = (
    *("biwi", "mead3d", "vocaset", "biwi_faceformer", "puppet_hubert", "puppet_codetalker_prior", "puppet_mask"),
    *("beat", "flame_clips", "live_link", "people"),
)
"""Those that are parsed in the quick suite: every corpus, trainer and kind of model; others differ by their sizes."""


@pytest.mark.parametrize(
    "config",
    [name if name[:-5] in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in EXPERIMENTS],
)
def test_every_shipped_experiment_is_parsed(config: str) -> None:
    printed = printed_config("--config", f"configs/experiment/{config}")
    assert printed["model"]["init_args"]["dim"]
    assert printed["trainer"]["logger"]["init_args"]["name"] == config.removesuffix(".yaml")


NAMED: dict[str, tuple[list[str], str]] = {
    "a file of the user's": (["--config", "mine.yaml"], "mine"),
    "the first of several files": (["--config", "mine.yaml", "--config", "other.yaml"], "mine"),
    "a file of callbacks before it": (["--config", "extra.yaml", "--config", "mine.yaml"], "mine"),
    "the option": (["--config", "mine.yaml", "--name=third"], "third"),
    "a name in the file": (["--config", "named.yaml"], "chosen"),
    "the logger's own": (["--config", "mine.yaml", "--trainer.logger.init_args.name=own"], "own"),
    "an interpolation of 1.x": (["--config", "mine.yaml", "--config", "former.yaml"], "mine"),
    "no file": (["--model=DualPathDiffusion", "--data=Puppet"], "fit"),
    "a list of loggers": (["--config", "configs/experiment/puppet.yaml", "--config", "loggers.yaml"], "puppet"),
    "Weights & Biases": (["--config", "mine.yaml", "--config", "configs/logger/wandb.yaml"], "mine"),
}


QUICK_NAMES = ("the first of several files", "the option", "an interpolation of 1.x", "a list of loggers")


@pytest.mark.parametrize(
    "case", [name if name in QUICK_NAMES else pytest.param(name, marks=pytest.mark.slow) for name in NAMED]
)
def test_runs_carry_the_name_of_their_experiment(case: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    mine = "model: DualPathDiffusion\ndata: Puppet\n"
    loggers = "trainer:\n  logger:\n" + "".join(
        f"    - class_path: lightning.pytorch.loggers.{kind}Logger\n      init_args: {{save_dir: runs}}\n"
        for kind in ("CSV", "TensorBoard")
    )
    former = "trainer: {logger: {class_path: CSVLogger, init_args: {save_dir: runs, name: '${experiment_name:}'}}}\n"
    files = {"former": former, "mine": mine, "other": mine, "named": f"name: chosen\n{mine}", "loggers": loggers}
    for name, text in {**files, "extra": "trainer: {max_epochs: 3}\n"}.items():
        (tmp_path / f"{name}.yaml").write_text(text)
    words, expected = NAMED[case]
    logger = printed_config(*words)["trainer"]["logger"]
    first = logger[0] if isinstance(logger, list) else logger
    assert first["init_args"]["name"] == expected


@pytest.mark.slow
def test_sub_configs_and_interpolation_with_a_flag_over_a_file(
    fit: Fit, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "decoder.yaml").write_text("class_path: gru\ninit_args: {num_layers: 3}\n")
    (tmp_path / "mine.yaml").write_text(
        "model:\n  class_path: DualPathDiffusion\n  init_args:\n    decoder: decoder.yaml\n"
        "    warmup_steps: ${trainer.max_epochs}\ndata: Puppet\ntrainer: {max_epochs: 7, accelerator: cpu}\n"
    )
    assert fit("--trainer.max_epochs=2", config=str(tmp_path / "mine.yaml")) == 0
    made = tmp_path / "runs/mine/version_0/checkpoints/last.ckpt"
    hparams = torch.load(made, weights_only=True)["hyper_parameters"]
    assert hparams["decoder"]["init_args"]["num_layers"] == 3
    # The file says 7; the flag must win also where its value is interpolated.
    assert hparams["warmup_steps"] == 2


def test_two_processes_train_together(tiny_root: Path, tmp_path: Path) -> None:
    words = ["--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}", "--data.batch_size=2", *SMALL]
    ddp = ["--trainer.accelerator=cpu", "--trainer.devices=2", "--trainer.strategy=ddp"]
    out = [f"--trainer.logger.save_dir={tmp_path}"]
    words = ["fit", "--config", "configs/experiment/puppet.yaml", *words, *ddp, *out]
    done = processes.run(
        "facediff", *words, env={"OMP_NUM_THREADS": "1"}, timeout=240
    )  # Lightning starts the other one cold
    assert done.returncode == 0, done.stderr[-3000:]
    assert "world_size: 2" in done.stdout + done.stderr or "MEMBER: 2/2" in done.stdout + done.stderr
    run = tmp_path / "puppet" / "version_0" / "checkpoints"
    # Eight training clips, two clips a batch, two processes: two steps.
    assert torch.load(run / "last.ckpt", weights_only=True)["global_step"] == 2
    load_model(run / "best.ckpt")


@pytest.mark.parametrize("corpus", ["biwi.Biwi", "mead3d.Mead3D"])
def test_a_checkpoint_without_its_corpus_asks_for_the_folder(corpus: str, checkpoint: Path, tmp_path: Path) -> None:
    content = torch.load(checkpoint, weights_only=True)
    path = tmp_path / "moved.ckpt"
    torch.save(content | {DATA_SOURCE_KEY: {"class_path": f"facediff.data.{corpus}"}, DATA_OPTIONS_KEY: {}}, path)
    with pytest.raises(FaceDiffError, match="does not say where the corpus is; add --data.root"):
        words_of_checkpoint("test", path, [])


def rows_of(path: Path) -> list[dict[str, str]]:
    return list(csv.DictReader(path.read_text().splitlines()))


@pytest.mark.slow
def test_three_processes_score_as_one_does(
    checkpoint: Path, tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Four clips of test A and two of test B: neither number fits three processes, and one of them gets no clip.

    With the sampler that adds noise all the way: it must not depend on which clips share a batch.
    """
    words = ["--ckpt_path", str(checkpoint), "--data=tests.fakes.tiny.Tiny", f"--data.root={tiny_root}"]
    words += ["--model.sampler=ddpm", "--model.sampler.steps=3", "--trainer.enable_progress_bar=false"]
    ddp = ["--trainer.accelerator=cpu", "--trainer.devices=3", "--trainer.strategy=ddp"]
    for folder in ("one", "three"):
        (tmp_path / folder).mkdir()
    monkeypatch.chdir(tmp_path / "one")
    sizes = {"test": (3, 2), "validate": (1, 1)}  # the noise of a loss follows from the clips of a batch
    for command, (size, small) in sizes.items():
        assert main([command, *words, f"--data.batch_size={size}"]) == 0
        done = subprocess.run(
            [sys.executable, "-m", "facediff", command, *words, *ddp, f"--data.batch_size={small}"],
            capture_output=True,
            text=True,
            check=False,
            cwd=tmp_path / "three",
            env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[2]), "OMP_NUM_THREADS": "1"},
            timeout=600,
        )
        assert done.returncode == 0, done.stderr[-3000:]
    (mine,), (theirs,) = ([*(tmp_path / folder).glob("runs/validate/*/metrics.csv")] for folder in ("one", "three"))
    alone, together = ({k: float(v) for row in rows_of(path) for k, v in row.items() if v} for path in (mine, theirs))
    assert {"val/loss", "val/velocity", "val/lve"} <= alone.keys()
    assert {name: together[name] for name in alone} == pytest.approx(alone, rel=1e-5)
    for name in ("test_scores.csv", "test_sequences.csv"):
        (mine,) = (tmp_path / "one").rglob(name)
        (theirs,) = (tmp_path / "three").rglob(name)
        one, three = (rows_of(path) for path in (mine, theirs))
        # Two splits by five methods; four clips of test A and two of test B, each with five methods.
        assert len(one) == len(three) == {"test_scores.csv": 10, "test_sequences.csv": 30}[name]
        for row, other in zip(one, three, strict=True):
            for column, value in row.items():
                if column in ("mve", "lve", "fdd"):
                    assert float(other[column]) == pytest.approx(float(value), rel=1e-5)
                elif re.fullmatch(r"\d+\.\d+", value):  # ratios of sums in another order
                    assert float(other[column]) == pytest.approx(float(value), rel=1e-8)
                else:
                    assert other[column] == value
