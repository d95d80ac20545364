from __future__ import annotations

import csv
import json
from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.cli.referee import candidates_of, read_models
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


def test_a_plan_names_models_and_motion(tmp_path: Path) -> None:
    (tmp_path / "a.ckpt").touch()
    (tmp_path / "motion").mkdir()
    plan = tmp_path / "models.yaml"
    plan.write_text(
        f"models:\n  first: {tmp_path / 'a.ckpt'}\n  second: {{motion: {tmp_path / 'motion'}, layout: arkit, "
        f"frame_rate: 29.97, licence: theirs, commercial_use: forbidden}}\n"
    )
    first, second = read_models(plan)
    assert first.model == str(tmp_path / "a.ckpt")
    assert second.frame_rate == 29.97
    assert second.commercial_use == "forbidden"
    assert second.motion == tmp_path / "motion"
    assert [candidate.name for candidate in candidates_of([str(plan)], [], None, None)] == ["first", "second"]
    assert candidates_of(["puppet"], [], None, None) == candidates_of([], [], None, None)
    with pytest.raises(FaceDiffError, match="first"):
        candidates_of([str(plan), f"first={tmp_path / 'a.ckpt'}"], [], None, None)
    for wrong in ("models: [a.ckpt, b.ckpt]\n", f"models: {{one: {{motion: {tmp_path}, frame_rate: 0}}}}\n"):
        plan.write_text(wrong)
        with pytest.raises(FaceDiffError, match="models.*; expected"):
            read_models(plan)
    plan.write_text("models: {one: {layout: arkit}}\n")
    with pytest.raises(FaceDiffError, match=r"models\.one"):
        read_models(plan)
    plan.write_text("models: {}\n")
    with pytest.raises(FaceDiffError, match="names no model"):
        read_models(plan)
