"""Wrong values of fit's and test's options: one sentence that names the option, exit status 2, nothing written.

A value is checked by whoever knows its range: the constructor, the trainer's table, or the parser. The table below has
one line for each way that a value can be wrong; tests/models/test_constructor_arguments.py draws wild values for every
argument of every constructor.
"""

from __future__ import annotations

import re
import shlex
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import soundfile
import torch

from facediff.cli.app import main
from facediff.cli.lightning import refuse_repeated
from facediff.cli.lightning_cli import refuse_missing_corpus
from facediff.cli.trainer_options import RANGES, check_trainer
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError

Fit = Callable[..., int]

QUICK = [
    (["--model.dim=33"], "--model.dim 33"),
    (["--trainer.precision=bf16-true"], "--trainer.precision bf16-true"),
    (["--trainer.enable_checkpointing=false"], "--trainer.enable_checkpointing false"),
    (["--trainer.limit_train_batches=0"], "--trainer.limit_train_batches 0"),
    (["--trainer.logger.save_dir=/dev/null/x"], "/dev/null/x"),
    (
        ["--trainer.callbacks=facediff.callbacks.SamplingPreview", "--trainer.callbacks.clips=0"],
        "SamplingPreview.clips",
    ),
]
SLOW = [
    (["--model.learning_rate=.inf"], "--model.learning_rate"),
    (["--trainer.strategy=nope"], "--trainer.strategy nope"),
    (["--model.sampler.steps=100000"], "--model.sampler.steps 100000"),
    (["--data.num_workers=-1"], "--data.num_workers -1"),
    (["--name=../elsewhere"], "--name ../elsewhere"),
    (["--trainer.max_epochs=-5"], "--trainer.max_epochs -5"),
    (["--seed_everything=-1"], "--seed_everything -1"),
    (["--model.decoder.num_heads=3"], "--model.decoder.num_heads 3"),
    (["--model.protocol=nope"], "--model.protocol nope"),
    (["--data.root=/dev/null"], "/dev/null"),
    (["--name="], "--name"),
    (["--trainer.max_epoch=3"], "--trainer.max_epoch"),
    (["--trainer.devices=99"], "--trainer.devices 99"),
    (["--model.dim=0"], "--model.dim 0"),
    (["--model.dim=1099511627776"], "--model.dim 1099511627776"),
    (["--model.learning_rate=-1"], "--model.learning_rate -1"),
    (["--model.warmup_steps=-5"], "--model.warmup_steps -5"),
    (["--model.decoder.dropout=1.5"], "--model.decoder.dropout 1.5"),
    (["--model.decoder.num_layers=-1"], "--model.decoder.num_layers -1"),
    (["--model.audio_encoder.num_layers=-1"], "--model.audio_encoder.num_layers -1"),
    (["--model.sampler.steps=0"], "--model.sampler.steps 0"),
    (["--model.diffusion_steps=0"], "--model.diffusion_steps 0"),
    (["--model.identity_dropout=2"], "--model.identity_dropout 2"),
    (["--model.metrics=[nope]"], "--model.metrics"),
    (["--model.unseen_identity=x"], "--model.unseen_identity x"),
    (["--data.batch_size=0"], "--data.batch_size 0"),
    (["--data.num_workers=100000"], "--data.num_workers 100000"),
    (["--data.window=0"], "--data.window 0"),
    (["--data.reference_frames=-1"], "--data.reference_frames -1"),
    (["--data.root="], "--data.root"),
    (["--data.root=/there/is/none"], "/there/is/none"),
    (["--data.train_identities=[Z]"], "--data.train_identities Z"),
    (["--data.lips=nope.txt"], "nope.txt"),
    (["--data.people=[/dev]"], "/dev"),
    (["--seed_everything=99999999999"], "--seed_everything 99999999999"),
    (["--seed_everything=x"], "--seed_everything x"),
    (["--trainer.accelerator=nope"], "--trainer.accelerator nope"),
    (["--trainer.accelerator=tpu"], "--trainer.accelerator tpu"),
    (["--trainer.precision=17"], "--trainer.precision 17"),
    (["--trainer.devices=0"], "--trainer.devices 0"),
    (["--trainer.devices=x"], "--trainer.devices x"),
    (["--trainer.limit_train_batches=x"], "--trainer.limit_train_batches x"),
    (["--trainer.limit_train_batches=1.5"], "--trainer.limit_train_batches 1.5"),
    (["--trainer.callbacks=nope.Nope"], "nope.Nope"),
    (["--trainer.callbacks=EarlyStopping"], "--trainer.callbacks.monitor"),
    (["--trainer.gradient_clip_val=-1"], "--trainer.gradient_clip_val -1"),
    (["--trainer.gradient_clip_algorithm=x"], "--trainer.gradient_clip_algorithm x"),
    (["--trainer.val_check_interval=0"], "--trainer.val_check_interval 0"),
    (["--trainer.val_check_interval=1000"], "val_check_interval"),
    (["--trainer.max_time=x"], "--trainer.max_time x"),
    (["--trainer.profiler=nope"], "--trainer.profiler nope"),
    (["--trainer.barebones=true"], "--trainer.barebones true"),
    (["--trainer.deterministic=maybe"], "--trainer.deterministic maybe"),
    (["--model.optoin=3"], "--model.optoin"),
    (["--weights_only=maybe"], "--weights_only maybe"),
]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("words", "named"),
    [*QUICK, *(pytest.param(*case, marks=pytest.mark.slow) for case in SLOW)],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_value_is_one_sentence(
    words: list[str],
    named: str,
    fit: Fit,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    logger = ["--trainer.logger=CSVLogger", f"--trainer.logger.save_dir={tmp_path}/runs"]
    given = {word.partition("=")[0] for word in words}
    assert fit(*(word for word in logger if word.partition("=")[0] not in given), *words) == 2
    error = capsys.readouterr().err.strip().splitlines()[-1]
    assert error.startswith("facediff: error: ")
    assert named in error
    assert not list(tmp_path.rglob("*.ckpt"))


@pytest.mark.parametrize("name", RANGES)
@pytest.mark.parametrize("value", [-7, -0.5, float("nan"), float("inf"), 1j])
def test_no_option_of_the_trainer_takes_every_number(name: str, value: object) -> None:
    with pytest.raises(FaceDiffError, match=rf"trainer\.{name} "):
        check_trainer({name: value})


def test_usual_options_of_the_trainer_pass() -> None:
    check_trainer({"max_epochs": -1, "limit_val_batches": 0, "limit_train_batches": 0.5, "fast_dev_run": True})
    check_trainer({"devices": "auto", "accelerator": "auto", "val_check_interval": 0.25, "gradient_clip_val": 1})
    check_trainer({"precision": "bf16-mixed"})
    check_trainer({"precision": 32})


@pytest.mark.parametrize(
    "words",
    [
        ["--ckpt_path=a.ckpt", "--ckpt_path=b.ckpt"],
        ["--ckpt_path", "a.ckpt", "--ckpt_path=b.ckpt"],
        ["--model.dim=3", "--model.init_args.dim=4"],
        ["--trainer.max_epochs", "1", "--trainer.max_epochs", "2"],
    ],
)
def test_an_option_given_twice_is_refused(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["fit", *words]) == 2
    assert words[0].partition("=")[0] in capsys.readouterr().err


def test_options_that_add_may_be_repeated() -> None:
    refuse_repeated(["--config=a", "--config", "b", "--trainer.callbacks+=A", "--trainer.callbacks+=B"])
    refuse_repeated(["--model.dim=3", "--model.dim=3", "--data.root=x", "--model.decoder=gru"])


@pytest.fixture
def own(checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A checkpoint whose corpus is a file of the working folder, which nothing has imported."""
    content = torch.load(checkpoint, weights_only=True)
    content[DATA_SOURCE_KEY]["class_path"] = "my_corpus.Mine"
    torch.save(content, tmp_path / "own model.ckpt")
    (tmp_path / "my_corpus.py").write_text(
        "from tests.fakes.tiny import Tiny\n\n\nclass Mine(Tiny):\n    corpus_name = 'mine'\n"
    )
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.delitem(sys.modules, "my_corpus", raising=False)
    return tmp_path / "own model.ckpt"


def advised(error: str) -> list[str]:
    """The words that an error's sentence asks to add."""
    found = re.search(r"add  (.*?)  and", error)
    assert found is not None, error
    return shlex.split(found[1])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_the_advice_for_a_corpus_of_ones_own_works(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """From the refusal to the animation, by nothing but what the commands print."""
    words = ["adapt", "--checkpoint", str(own), "--person", "C", "-o", "adapted to C.ckpt"]
    words += ["--epochs", "1", "--accelerator", "cpu", "--quiet"]
    assert main(words) == 2
    assert "my_corpus" not in sys.modules
    assert main([*words, *advised(capsys.readouterr().err)]) == 0
    following = shlex.split(capsys.readouterr().out.partition("next: ")[2])
    soundfile.write("speech.wav", np.random.default_rng(0).normal(0, 0.1, 8000), 16_000)
    assert following[0] == "facediff"
    assert main(following[1:]) == 0
    assert Path(following[-1]).is_file()


@pytest.mark.filterwarnings("ignore")
@pytest.mark.slow
def test_the_advice_for_scoring_a_corpus_of_ones_own_works(own: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["test", f"--ckpt_path={own}", "--trainer.enable_progress_bar=false", "--trainer.accelerator=cpu"]
    assert main(words) == 2
    assert "my_corpus" not in sys.modules
    assert main([*words, *advised(capsys.readouterr().err)]) == 0
    assert list(Path("runs").rglob("test_scores.csv"))


def test_an_accelerator_that_is_not_there_is_named_by_adapt(
    checkpoint: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--person", "C", "-o", str(tmp_path / "c.ckpt"), "--epochs", "1", "--quiet"]
    assert main(["adapt", "--checkpoint", str(checkpoint), *words, "--accelerator", "nope"]) == 2
    assert "--accelerator nope" in capsys.readouterr().err


def test_a_corpus_that_is_not_there_is_refused_before_the_model_is_built(tmp_path: Path) -> None:
    missing = str(tmp_path / "BIWI")
    with pytest.raises(FaceDiffError, match="BIWI: no such folder"):
        refuse_missing_corpus({"class_path": "facediff.data.Biwi", "init_args": {"root": missing}})
    recordings = (("Beat", missing, "BIWI: no such folder"), ("LiveLink", str(tmp_path), "holds no recordings"))
    for name, root, message in recordings:
        with pytest.raises(FaceDiffError, match=message):
            refuse_missing_corpus({"class_path": f"facediff.data.parametric.{name}", "init_args": {"root": root}})
    refuse_missing_corpus({"class_path": "facediff.data.Biwi", "init_args": {"root": "s3://bucket/biwi.zarr"}})
    refuse_missing_corpus({"class_path": "facediff.data.Puppet", "init_args": {"root": missing}})
