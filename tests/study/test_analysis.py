"""Reports: preferences of simulated raters are recovered, careless raters left out, and tables are as stated."""

from __future__ import annotations

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.reporting.documents import markdown
from facediff.study import analyse
from facediff.study.analysis import check_rater
from facediff.study.answers import Rater
from facediff.study.definition import Rule, Study
from facediff.study.report_files import blocks, main_table, write_report
from facediff.study.texts import Questionnaire
from tests.fakes.study import SCORES, simulate, small_study

HOSTILE = "=cmd|' /C calc'!A0 <script>alert(1)</script> \\input{x} %_& | `"


def expected(first: str, second: str) -> float:
    return 1 / (1 + math.exp(SCORES[second] - SCORES[first]))


def answered(study: Study, rater: Rater, **sides: str) -> Rater:
    """A rater who answers all trials of a kind so: a side, or a condition's name."""
    answers = {}
    for trial in study.trials_of(rater.number):
        wanted = sides.get(trial.kind)
        given = dict(rater.answers[trial.id].answers)
        if wanted is not None:
            side = wanted if wanted in ("left", "right") else "left" if trial.left == wanted else "right"
            given = dict.fromkeys(given, side)
        answers[trial.id] = replace(rater.answers[trial.id], answers=given)
    return replace(rater, answers=answers)


def test_known_preferences_are_recovered_within_the_stated_intervals() -> None:
    study = small_study(methods=("ours", "theirs", "third"), clips=9, pairs="all")
    inside = {"wilson": [], "raters": []}
    for seed in range(14):
        report = analyse(study, simulate(study, SCORES, 54, seed=seed), resamples=200, seed=seed)
        for each in report.preferences:
            for name, (low, high) in (("wilson", each.interval), ("raters", each.between_raters)):
                inside[name].append(low <= expected(each.first, each.second) <= high)
        assert len(report.preferences) == 2 * 6
    # Of some 170 intervals of 95 %; the two questions of a study are independent, pairs of one question are not.
    assert {name: 0.88 < np.mean(found) < 0.998 for name, found in inside.items()} == dict.fromkeys(inside, True)


def test_preferences_are_counted_by_hand() -> None:
    study = small_study(clips=2, still=1, same=1, repeats=0, rule=Rule(most_on_one_side=1.0, least_right=1.0))
    (rater,) = simulate(study, SCORES, 1)
    always = answered(study, rater, pair="ours", still="truth", same="left")
    never = replace(answered(study, rater, pair="ours", still="still", same="left"), token="e" * 32)
    left = answered(study, replace(rater, token="d" * 32), pair="left", still="truth", same="right")
    report = analyse(study, [always, never, left], resamples=0)
    assert [bool(check.reasons) for check in report.checks] == [False, True, False]
    assert "named the truth in 0% of the controls" in report.checks[1].reasons[0]
    for each in report.preferences:
        pairs = [t for t in study.trials_of(0) if t.kind == "pair" and each.second in (t.left, t.right)]
        on_left = sum(trial.left == "ours" for trial in pairs)
        assert (each.wins, each.losses) == (len(pairs) + on_left, len(pairs) - on_left)
        assert each.share == each.wins / (2 * len(pairs))
    share, _, count = report.sides["realism"]
    assert (share, count) == (0.5, 2)


def test_the_rule_decides_who_is_counted() -> None:
    study = small_study(clips=4, still=2, repeats=2, rule=Rule(least_consistent=1.0, most_on_one_side=0.7))
    rater = answered(study, simulate(study, SCORES, 1)[0], pair="ours", still="truth", repeat="ours", same="left")
    assert check_rater(rater, study).reasons == ()
    torn = answered(study, rater, repeat="theirs")
    pairs = [t for t in study.trials_of(0) if t.kind == "repeat" and "theirs" in (t.left, t.right)]
    assert check_rater(torn, study).consistent == 1 - len(pairs) / 2 or check_rater(torn, study).consistent == 0
    assert ("alike" in " ".join(check_rater(torn, study).reasons)) == (check_rater(torn, study).consistent < 1)
    lazy = answered(study, rater, pair="left", still="truth", repeat="left", same="left")
    assert check_rater(lazy, study).one_side > 0.7
    assert any("one side" in reason for reason in check_rater(lazy, study).reasons)
    early = replace(rater, finished=None)
    assert check_rater(early, study).reasons == ("has not finished",)
    assert check_rater(early, replace(study, rule=replace(study.rule, finished=False))).reasons == ()


def test_answers_without_difference_are_half_for_each() -> None:
    study = small_study(clips=6, no_difference=True)
    report = analyse(study, simulate(study, SCORES, 40, no_difference=0.4, seed=1))
    for each in report.preferences:
        assert (each.same > 0) == (each.question == "realism")
        assert each.share == pytest.approx((each.wins + each.same / 2) / each.answers)
    assert "no difference" in markdown(blocks([report]))


def test_noise_is_seldom_called_a_preference() -> None:
    """Of studies in which nothing is better, at most the stated share has any corrected p below 0.05."""
    study = small_study(methods=("ours", "theirs", "third"), clips=6, rule=Rule(least_right=0, most_on_one_side=1))
    even = dict.fromkeys(SCORES, 0.0)
    false = [
        any(
            each.p_corrected < 0.05
            for each in analyse(study, simulate(study, even, 24, seed=s), resamples=0).preferences
            if each.question == "realism"
        )
        for s in range(70)
    ]
    assert np.mean(false) < 0.1


def test_the_table_has_a_column_for_every_data_set_and_hostile_names_stay_text(tmp_path: Path) -> None:
    study = small_study(clips=3, methods=("ours", HOSTILE))
    scores = {**SCORES, HOSTILE: 0.0}
    raters = [replace(r, comments={"comments": HOSTILE}) for r in simulate(study, scores, 8)]
    reports = [analyse(study, raters, name=name) for name in ("BIWI", "3DMEAD")]
    table = main_table(reports, "realism")
    rows = table.rows
    assert table.head[1:] == ["BIWI", "3DMEAD"]
    assert [row[0] for row in rows] == [f"ours and {HOSTILE}", "ours and truth"]
    each = reports[0].preference("realism", "ours", "truth")
    assert each is not None
    assert rows[1][1] == f"{100 * each.share:.2f} [{100 * each.interval[0]:.2f}, {100 * each.interval[1]:.2f}]"
    files = {path.name: path.read_text() for path in write_report(reports, tmp_path / "out")}
    assert set(files) == {
        *("report.md", "report.html", "report.json", "table.tex", "table.csv", "answers.csv", "comments.csv"),
    }
    assert "<script>" not in files["report.html"]
    assert r"\input" not in files["table.tex"].replace(r"\textbackslash{}input", "")
    assert files["table.tex"].count(r"\toprule") == 2
    assert write_report(reports, tmp_path / "again")[1].read_text() == files["report.html"]
    with (tmp_path / "out" / "table.csv").open(newline="") as stream:
        records = list(csv.DictReader(stream))
    assert len(records) == 2 * 2 * 2
    assert float(records[0]["share"]) == reports[0].preferences[0].share
    for name in ("answers.csv", "comments.csv"):
        with (tmp_path / "out" / name).open(newline="") as stream:
            cells = [cell for row in csv.reader(stream) for cell in row]
        assert not [cell for cell in cells if cell.startswith("=")]
    content = json.loads(files["report.json"])
    assert [each["name"] for each in content["studies"]] == ["BIWI", "3DMEAD"]
    answered_questions = sum(len(answer.answers) for rater in raters for answer in rater.answers.values())
    assert len(list(csv.DictReader(files["answers.csv"].splitlines()))) == 2 * answered_questions


def test_the_manuals_file_of_questions_is_read(tmp_path: Path) -> None:
    manual = (Path(__file__).parents[2] / "docs" / "user_study.md").read_text(encoding="utf-8")
    (tmp_path / "q.yaml").write_text(re.findall(r"```yaml\n(.*?)```", manual, re.DOTALL)[0], encoding="utf-8")
    found = Questionnaire(tmp_path / "q.yaml", ["en", "de"])
    assert [question.name for question in found.questions] == ["realism", "lip_sync", "emotion", "remarks"]
    assert found.rule == Rule()
