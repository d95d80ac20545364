"""Configs that are damaged or no configs at all: one sentence that names the file."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.cli.configs import check_config
from facediff.cli.lightning import find_config
from facediff.errors import FaceDiffError
from facediff.utils.files import config_dir
from facediff.utils.yaml_files import load_yaml
from tests.fakes.parsing import printed_config

BAD: dict[str, bytes] = {
    "not utf-8": b"model: \xff\xfe\xe4\n",
    "unknown alias": b"model: *nothing\n",
    "deep": b"model: " + b"[" * 5000 + b"]" * 5000,
    "twice": b"seed_everything: 0\nseed_everything: 1\n",
    "list": b"- 1\n- 2\n",
    "empty": b"",
    "no end": b'model: "open\n',
}


@pytest.mark.parametrize("name", BAD)
def test_a_bad_config_is_refused_in_one_sentence(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "mine.yaml"
    path.write_bytes(BAD[name])
    assert main(["fit", "--config", str(path)]) == 2
    printed = capsys.readouterr().err
    assert str(path) in printed
    assert printed.count("\n") == 1


def test_aliases_anchors_and_merges_may_be_used(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("base: &base {a: 1}\nmore:\n  <<: *base\n  <<: *base\n  b: [*base, *base]\n")
    check_config(path)


def test_a_config_within_a_config_is_checked_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "decoder.yaml").write_text("class_path: gru\ninit_args:\n  num_layers: 1\n  num_layers: 2\n")
    (tmp_path / "mine.yaml").write_text(
        "model:\n  class_path: DualPathDiffusion\n  init_args: {decoder: decoder.yaml}\n"
    )
    words = ["--config", "configs/experiment/puppet.yaml", "--config", str(tmp_path / "mine.yaml")]
    assert main(["fit", *words]) == 2
    assert "twice" in capsys.readouterr().err


@pytest.mark.parametrize(
    "tag", ["!!python/object/apply:os.system ['touch harm']", "!!python/name:os.system", "!mine x"]
)
def test_tags_run_nothing(
    tag: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.yaml").write_text(f"model: {tag}\n")
    assert main(["fit", "--config", "mine.yaml"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "harm").exists()


def test_plain_yaml_holds_numbers_and_texts_and_no_objects(tmp_path: Path) -> None:
    path = tmp_path / "plan.yaml"
    path.write_text("a: 1\nb: [x, 2.5, null, true]\nday: 2026-01-02\n")
    assert load_yaml(path, "") == {"a": 1, "b": ["x", 2.5, None, True], "day": "2026-01-02"}
    for text in ("a: !!python/name:os.system\n", "1: x\n", "[a]: x\n", "{[a]: x}\n"):
        path.write_text(text)
        with pytest.raises(FaceDiffError, match=re.escape(str(path))):
            load_yaml(path, "expected a plan")


def test_bundled_parts_are_named_inside_ones_own_config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From any folder; a file of the user's own at the same place comes first."""
    (tmp_path / "mine.yaml").write_text(
        "model: configs/model/voca_small.yaml\ndata: configs/data/puppet.yaml\n"
        "trainer: configs/trainer/published_cpu.yaml\n"
    )
    monkeypatch.chdir(tmp_path)
    config = printed_config("--config", "mine.yaml")
    assert config["trainer"]["max_epochs"] == 30
    assert config["model"]["class_path"].endswith("Voca")
    (tmp_path / "configs" / "trainer").mkdir(parents=True)
    (tmp_path / "configs" / "trainer" / "published_cpu.yaml").write_text("max_epochs: 7\n")
    assert printed_config("--config", "mine.yaml")["trainer"]["max_epochs"] == 7


@pytest.mark.parametrize("name", ["configs/trainer/cpu.yaml", "trainer/cpu"])
def test_a_bundled_part_is_given_as_a_config(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    config = printed_config("--config", name, "--model=Voca", "--data=Puppet")
    assert config["trainer"]["logger"]["init_args"]["save_dir"] == "runs"


def test_a_bundled_experiment_is_known_by_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_config("--config", "experiment/biwi") == str(config_dir() / "experiment" / "biwi.yaml")
    with pytest.raises(FaceDiffError, match=r"configs/experiment/biwi\.yaml"):
        find_config("--config", "experiment/bivi")
