from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.cli.referee import candidates_of
from facediff.errors import FaceDiffError


def test_the_bundled_model_is_judged_and_a_missing_motion_is_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "theirs").mkdir()
    words = ["--languages", "en", "--voices", "1", "--sentences", "2", "-o", str(tmp_path / "out")]
    assert main(["benchmark", "referee", "--motion", f"theirs={tmp_path / 'theirs'}", *words]) == 2
    assert "no such motion" in capsys.readouterr().err
    assert main(["benchmark", "referee", *words]) == 0
    printed = capsys.readouterr().out
    assert "puppet" in printed
    report = json.loads((tmp_path / "out" / "referee.json").read_text())
    assert report["rows"][0]["memory_bytes"] > 1e6
    assert report["rows"][0]["facts"]["commercial use"] == "allowed"
    with (tmp_path / "out" / "referee.csv").open(newline="") as stream:
        assert [row["model"] for row in csv.DictReader(stream)] == ["puppet", "reference"]
    assert "<td>puppet</td>" in (tmp_path / "out" / "referee.html").read_text()
    assert "| puppet |" in (tmp_path / "out" / "referee.md").read_text()


def test_speech_is_written_for_other_programs(tmp_path: Path) -> None:
    words = ["--languages", "en,it", "--voices", "1", "--sentences", "1"]
    assert main(["benchmark", "referee", "--write-speech", str(tmp_path / "speech"), *words]) == 0
    assert len(list((tmp_path / "speech" / "wav").glob("*.wav"))) == 2


def test_names_of_models_are_different(tmp_path: Path) -> None:
    (tmp_path / "a.ckpt").touch()
    assert candidates_of(["puppet"], [], None, None) == candidates_of([], [], None, None)
    with pytest.raises(FaceDiffError, match="name of two models"):
        candidates_of([f"one={tmp_path / 'a.ckpt'}", f"one={tmp_path / 'a.ckpt'}"], [], None, None)
