"""Wrong values of fit's and test's options: one sentence that names the option, exit status 2, nothing written.

A value is checked by whoever knows its range: the constructor, the trainer's table, or the parser, whose words are
jsonargparse's; tests/models/test_constructor_arguments.py draws wild values for every argument of every constructor.
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
from facediff.data.batch import DATA_SOURCE_KEY
from facediff.errors import FaceDiffError

Fit = Callable[..., int]

WRONG = [
    (["--model.dim=33"], "--model.dim 33"),
    (["--trainer.precision=bf16-true"], "--trainer.precision bf16-true"),
    (["--trainer.limit_train_batches=0"], "--trainer.limit_train_batches 0"),
    (["--trainer.gradient_clip_val=-1"], "--trainer.gradient_clip_val -1"),
    (["--trainer.logger.save_dir=/dev/null/x"], "/dev/null/x"),
    (["--name=../elsewhere"], "--name ../elsewhere"),
    (["--data.root=/there/is/none"], "/there/is/none"),
    (["--model.metrics=[nope]"], "nope"),
]
"""One for each door: the model's constructor, the trainer's table, the run's folder, its name, the corpus, metrics."""


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("words", "named"),
    [case if number < 3 else pytest.param(*case, marks=pytest.mark.slow) for number, case in enumerate(WRONG)],
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


@pytest.mark.parametrize(
    "option",
    [
        "--model.dim=16",
        "--model.decoder.num_layers=1",
        "--trainer.max_epochs=3",
        "--data.batch_size=2",
        "--model.sampler.steps=3",
    ],
)
@pytest.mark.parametrize("config", ["--config=", "-c "])
def test_an_option_before_its_config_is_refused(option: str, config: str, capsys: pytest.CaptureFixture[str]) -> None:
    """The config would count, without a word, or the parser's own words would."""
    words = f"{config}configs/experiment/puppet.yaml".split()
    assert main(["fit", option, *words, "--print_config"]) in (0, 2)
    printed = capsys.readouterr()
    flag, _, value = option.partition("=")
    name = flag.rpartition(".")[2]
    assert (f"{flag} stands before --config" in printed.err) or f"{name}: {value}\n" in printed.out


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


def test_a_corpus_that_is_not_there_is_refused_before_the_model_is_built(tmp_path: Path) -> None:
    missing = str(tmp_path / "BIWI")
    with pytest.raises(FaceDiffError, match="BIWI: no such folder"):
        refuse_missing_corpus({"class_path": "facediff.data.Biwi", "init_args": {"root": missing}})
    for name, root in (("Beat", missing), ("LiveLink", str(tmp_path))):
        with pytest.raises(FaceDiffError, match="holds no recordings"):
            refuse_missing_corpus({"class_path": f"facediff.data.parametric.{name}", "init_args": {"root": root}})
    refuse_missing_corpus({"class_path": "facediff.data.Biwi", "init_args": {"root": "s3://bucket/biwi.zarr"}})
    refuse_missing_corpus({"class_path": "facediff.data.Puppet", "init_args": {"root": missing}})
