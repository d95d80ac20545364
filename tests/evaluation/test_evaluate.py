from __future__ import annotations

import csv
import json
import pickle
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import run
from facediff.errors import FaceDiffError
from facediff.evaluation import read_region
from facediff.evaluation.report import text
from tests.evaluation.conftest import LENGTHS, LIPS, UPPER, VERTICES, Files, scores_of


def evaluate(*words: str | Path) -> int:
    return run("evaluate", [*map(str, words), "--quiet"])


def test_a_corpus_folder_says_everything(shared_files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    assert evaluate(shared_files.method(), shared_files.root, "--bootstrap", "50") == 0
    told = capsys.readouterr().out
    wanted = scores_of(shared_files.evaluate())
    for name in ("mve", "lve", "fdd"):
        assert f"{wanted[f'paper/{name}']:.4e} [" in told
        assert f"  {name}: in each" in told
    assert "lips lve.txt: 4 vertices, hash" in told
    assert "1 repeated in the source" in told
    assert "protocol paper" in told
    assert "95% intervals, 50 bootstrap resamples of the sequences, seed 0" in told
    assert "every clip was scored" in told
    assert f"{sum(LENGTHS.values())}          5" in told


def test_json_and_csv_hold_the_same_numbers(
    shared_files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "new" / "scores.csv"
    words = ["--protocol", "facediffuser", "--protocol", "diffspeaker", "--bootstrap", "20", "--csv", table]
    methods = [f"a={shared_files.method()}", shared_files.truth, "--method", f"b={shared_files.method('theirs')}"]
    assert evaluate(*methods, *words, "--json", "-") == 0
    printed = json.loads(capsys.readouterr().out)
    assert evaluate(*methods, *words, "--json", tmp_path / "scores.json") == 0
    assert json.loads((tmp_path / "scores.json").read_text()) == printed
    assert "difference, over the sequences" in capsys.readouterr().out
    assert [method["name"] for method in printed["methods"]] == ["a", "b"]
    wanted = scores_of(shared_files.evaluate("ours", "theirs", protocols=["facediffuser", "diffspeaker"]), 1)
    found = printed["methods"][1]["scores"]
    assert {f"{each['protocol']}/{each['metric']}": each["value"] for each in found} == wanted
    regions = {each["metric"]: each["region"] for each in found}
    assert regions["mve"] == "all vertices"
    assert (regions["lve"]["count"], regions["fdd_absolute"]["count"]) == (len(LIPS), len(UPPER))
    assert all(each["frames"] == sum(LENGTHS.values()) and each["sequences"] == 5 for each in found)
    assert {each["method"] for each in printed["comparisons"]} == {"b"}
    with table.open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["method"], row["clip"]) for row in rows] == [(name, clip) for name in "ab" for clip in sorted(LENGTHS)]
    mean = np.mean([float(row["diffspeaker/lve"]) for row in rows if row["method"] == "b"])
    assert mean == pytest.approx(wanted["diffspeaker/lve"], rel=1e-12)
    assert {row["lips_count"] for row in rows} == {str(len(LIPS))}
    assert not list(tmp_path.glob("**/.*"))


def test_metrics_are_chosen_by_name(files: Files, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    chosen = ["--metric", "lip_vertex_error:squared=false", "--metric", "mouth_opening_difference"]
    words = ["--protocol", "meshtalk", "--lip-pairs", "1-2,7-11", "--csv", tmp_path / "scores.csv", *chosen]
    assert evaluate(files.method(), files.root, *words, "--json", tmp_path / "scores.json") == 0
    printed = capsys.readouterr().out
    data = json.loads((tmp_path / "scores.json").read_text())
    scores = {f"{each['protocol']}/{each['metric']}": each for each in data["methods"][0]["scores"]}
    assert scores["metrics/lip_vertex_error:squared=false"]["value"] == scores["meshtalk/lve"]["value"]
    assert scores["metrics/mouth_opening_difference"]["region"]["count"] == 2
    assert "mouth_opening_difference: in each frame" in data["protocols"]["metrics"]
    with (tmp_path / "scores.csv").open(newline="") as stream:
        row = next(csv.DictReader(stream))
    assert row["metrics/lip_vertex_error:squared=false"] == row["meshtalk/lve"]
    assert f"{scores['metrics/mouth_opening_difference']['value']:.4e} [" in printed
    with pytest.raises(FaceDiffError, match="mouth_opening_difference.*--lip-pairs"):
        evaluate(files.method(), files.root, "--metric", "mouth_opening_difference")
    with pytest.raises(FaceDiffError, match="lip_vertex_error"):
        evaluate(files.method(), files.root, "--metric", "lip_vertex_eror")


def test_what_is_missing_stands_under_the_scores(files: Files, capsys: pytest.CaptureFixture[str]) -> None:
    ours = files.method()
    files.write(ours / "A_e01_condition_A.npy", files.read(ours / "A_e01_condition_A.npy")[:5])
    (ours / "A_e02_condition_A.npy").write_bytes(b"")
    (ours / "A_e03_condition_A.npy").unlink()
    files.write(ours / "A_e77_condition_A.npy", np.zeros((2, VERTICES, 3)))
    assert evaluate(ours, files.root, "--method", files.method("theirs")) == 0
    told = capsys.readouterr().out
    assert "ours: frames cut: 1: A_e01 (prediction 0, truth 4)" in told
    assert "ours: clips without a prediction: 1: A_e03" in told
    assert "ours: predictions without a truth: 1: A_e77_condition_A.npy" in told
    assert "ours: A_e02 is left out: " in told
    assert "the methods were not scored on the same sequences" in told


def test_regions_come_from_masks_and_weights(tmp_path: Path) -> None:
    masks = {"lips": np.array([3, 1, 3]), "forehead": np.array([5]), "eye_region": np.array([5, 7])}
    (tmp_path / "FLAME_masks.pkl").write_bytes(pickle.dumps(masks))
    (tmp_path / "mouth.txt").write_text("0.1\n0.2\n0.05\n0.9\n")
    lips, upper = (read_region(part, 8, folder=tmp_path) for part in ("lips", "upper_face"))
    assert (lips.indices, upper.indices) == ((1, 3), (5, 7))
    weighted = read_region("lips", 4, folder=tmp_path, source="mouth.txt>0.1")
    assert (weighted.indices, weighted.name) == ((1, 3), "mouth.txt>0.1")
    with pytest.raises(FaceDiffError, match="4 vertices, not of 5"):
        read_region("lips", 5, folder=tmp_path, source="mouth.txt>0.1")
    assert read_region("upper_face", 3, source="all").count == 3


def test_a_difference_stands_under_its_own_score(shared_files: Files) -> None:
    report = shared_files.evaluate("ours", "theirs", protocols=["paper"], bootstrap=0)
    first, *others = report.comparisons  # the second method has no value of the first score
    more = [replace(each, method="third") for each in report.comparisons]
    lines = text(replace(report, comparisons=[*others, *more])).splitlines()
    place = next(place for place, line in enumerate(lines) if line.startswith("difference, over the sequences"))
    head, second, third = (line.split() for line in lines[place + 1 : place + 4])
    assert head == [*(each.metric for each in others), first.metric, "sequences"]
    assert third[:3] == ["third", "−", "ours"]
    assert second[3:] == [*third[3 : 2 + len(head)][:-1], "-", third[-1]]
