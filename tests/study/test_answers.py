"""Answers from files and from the server: each rater once, and what was first stays."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest

from facediff.cli.app import main
from facediff.study import analyse_folder
from facediff.study.answers import merge
from tests.fakes.study import SCORES, as_file, simulate, small_study, write_answers, write_study


def test_files_and_database_of_one_rater_are_one_rater(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    study = small_study(clips=3)
    folder = write_study(tmp_path / "study", study)
    write_answers(folder, study, 3)
    downloads = tmp_path / "downloads"
    downloads.mkdir()
    for rater in simulate(study, SCORES, 5):
        (downloads / f"{rater.number}.json").write_text(json.dumps(as_file(rater, study)))
    report = analyse_folder(folder, [downloads, downloads / "0.json"])
    assert len(report.raters) == 5
    assert report.notes == ()
    (downloads / "5.json").write_text("{}")
    (downloads / "6.json").write_text(json.dumps(as_file(rater, study) | {"study": "0" * 16}))
    assert main(["study", "report", str(folder), "--answers", str(downloads), "--bootstrap", "20"]) == 1
    said = capsys.readouterr().out
    assert said.count("set aside") == 2
    assert "5.json" in said
    assert "6.json" in said


def test_raters_of_several_sources_are_merged_and_what_was_first_stays() -> None:
    study = small_study(clips=3)
    rater = simulate(study, SCORES, 1)[0]
    names = list(rater.answers)
    one = replace(rater, answers={name: rater.answers[name] for name in names[:2]}, finished=None)
    other = replace(rater, answers={n: replace(a, seconds=99.0) for n, a in rater.answers.items()})
    (whole,) = merge([[one], [other]])
    assert [whole.answers[name].seconds == 99 for name in names] == [False, False, *[True] * (len(names) - 2)]
    assert whole.finished == rater.finished
