"""What runs, what runs again, and what a kill leaves; the commands themselves are played by a stand-in."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from facediff.benchmark import Cell, cells_of, read_plan, read_result, report_of
from facediff.benchmark.outline import outline_of, read_results
from facediff.benchmark.results import cell_file
from facediff.benchmark.running import (
    BEST,
    LAST,
    RUNS,
    STATE,
    Runner,
    Setting,
    pending,
    run_cells,
)
from facediff.benchmark.writing import document
from facediff.errors import FaceDiffError
from facediff.reporting.documents import markdown
from tests.benchmark.conftest import PLAN
from tests.fakes.waiting import wait_until

LAUNCHER = (sys.executable, "-m", "facediff.benchmark.exit_with_parent", "tests.fakes.stand_in")
ONE_SEED = PLAN.replace("[0, 1]", "[0]")


def setting(folder: Path, **options: Any) -> Setting:  # noqa: ANN401
    facts = {"protocol": "paper", "metrics": (), "weights": "last", "threads": 1, "launcher": LAUNCHER}
    return Setting(folder / "out", **{**facts, **options})


def run(folder: Path, *, retry_failed: bool = False) -> list[Cell]:
    """Run what is pending, and give back the cells that ran."""
    cells = cells_of(read_plan(folder / "plan.yaml"))
    left = pending(cells, folder / "out", retry_failed=retry_failed)
    return [cell for cell, _ in run_cells(left, setting(folder), workers=1)]


def calls(folder: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (folder / "calls").read_text().splitlines()]


def report(folder: Path) -> str:
    plan = read_plan(folder / "plan.yaml")
    outline = outline_of(plan, cells_of(plan), "")
    results, missing = read_results(folder / "out", outline)
    text = markdown(document(report_of(outline, results, missing, resamples=50)))
    measured = ("training", "memory", "RTF", "facediff ")  # columns and lines that a clock decides
    lines = [line for line in text.splitlines() if not any(word in line for word in measured)]
    return "\n".join(line.rpartition("| 2 |")[0] or line for line in lines)


def test_every_cell_is_trained_and_tested_once_with_its_seed(folder: Path) -> None:
    assert len(run(folder)) == 4
    done = calls(folder)
    assert [each["command"] for each in done].count("test") == 4
    assert sorted(each["seed_everything"] for each in done if each["name"] == "fit") == ["0", "0", "1", "1"]
    priors = [each for each in done if each["name"] == "prior"]
    assert len(priors) == 2
    followers = [each for each in done if "model.prior" in each]
    assert {Path(each["model.prior"]).parts[-4] for each in followers} == {"prior"}
    assert run(folder) == []
    (result,) = (read_result(cell_file(folder / "out", cell)) for cell in cells_of(read_plan(folder / "plan.yaml"))[:1])
    assert result is not None
    assert result.measured["fit"]["memory"]


def test_a_changed_config_runs_its_own_cells_again_and_those_alone(folder: Path) -> None:
    (folder / "plan.yaml").write_text(ONE_SEED)
    run(folder)
    (folder / "one.yaml").write_text("# a comment\nmodel: part.yaml\n")
    assert run(folder) == []
    (folder / "two.yaml").write_text("model: {dim: 5}\n")
    assert {cell.row for cell in run(folder)} == {"two"}
    (folder / "two.yaml").write_text("model: {dim: 4}\n")
    assert run(folder) == []  # the results of before are found again
    (folder / "part.yaml").write_text("dim: 4\n")  # which one.yaml names, and so does the prior of two
    assert {cell.row for cell in run(folder)} == {"one", "two"}
    (folder / "plan.yaml").write_text(PLAN.replace("[0, 1]", "[0, 2]"))
    assert {cell.seed for cell in run(folder)} == {2}


def test_files_that_options_name_and_folders_without_a_manifest_count(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    (folder / "plan.yaml").write_text(ONE_SEED)
    plan = read_plan(folder / "plan.yaml")
    corpus = next(iter(plan.corpora.values()))
    method = replace(plan.methods["two"], options={"model.decoder": "mine.yaml"})
    plan = replace(
        plan, baseline="two", methods={"two": method}, corpora={corpus.name: replace(corpus, root=folder / "data")}
    )

    def key() -> str:
        (cell,) = cells_of(plan)
        return cell.key

    keys = [key()]
    for file, text in (("mine.yaml", "width: 1"), ("mine.yaml", "width: 2"), ("data/a.npy", "a"), ("data/a.npy", "ab")):
        (folder / file).parent.mkdir(exist_ok=True)
        (folder / file).write_text(text)
        keys += [key()]
    assert len({*keys}) == len(keys)


@pytest.mark.parametrize("place", ["", "installed in place"])
def test_changed_code_of_ones_own_runs_its_own_cells_again(
    folder: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.syspath_prepend(folder / place)
    (folder / "plan.yaml").write_text(ONE_SEED)
    (folder / "two.yaml").write_text("model: {class_path: mine.model.Mine}\n")
    (folder / place / "mine").mkdir(parents=True)
    (folder / place / "mine" / "__init__.py").touch()
    (folder / place / "mine" / "parts.py").write_text("WIDTH = 1")
    run(folder)
    assert run(folder) == []
    cells = cells_of(read_plan(folder / "plan.yaml"))
    (folder / place / "mine" / "parts.py").write_text("WIDTH = 2")
    problems = [outcome.problem for _, outcome in run_cells(cells, setting(folder), workers=1)]
    assert [bool(problem) for problem in problems] == [False, False]  # they are trained
    assert {cell.row for cell in run(folder)} == {"two"}


def test_a_training_whose_checkpoint_was_deleted_is_done_again(folder: Path) -> None:
    (folder / "plan.yaml").write_text(ONE_SEED)
    run(folder)
    cell = next(cell for cell in cells_of(read_plan(folder / "plan.yaml")) if cell.row == "two")
    place = folder / "out" / RUNS / cell.folder_name
    (place / "prior" / LAST).unlink()
    cell_file(folder / "out", cell).unlink()
    before = len(calls(folder))
    assert [each.row for each in run(folder)] == ["two"]
    assert [each["name"] for each in calls(folder)[before:] if each["command"] == "fit"] == ["prior"]
    result = read_result(cell_file(folder / "out", cell))
    assert result is not None
    assert not result.problem


def test_a_changed_model_folder_is_tested_again_but_its_card_may_change(folder: Path) -> None:
    (folder / "plan.yaml").write_text("corpora: {tiny: {}}\nmethods: {published: {checkpoint: published}}\n")
    (folder / "published").mkdir()
    for name in ("config.json", "model.safetensors", "assets.npz", "README.md"):
        (folder / "published" / name).write_text("first")
    assert len(run(folder)) == 1
    (folder / "published" / "README.md").write_text("changed")
    assert run(folder) == []
    (folder / "published" / "model.safetensors").write_text("changed")
    assert len(run(folder)) == 1


def test_a_config_that_is_edited_in_between_trains_nothing_under_its_old_hash(folder: Path) -> None:
    (folder / "plan.yaml").write_text(ONE_SEED)
    cells = cells_of(read_plan(folder / "plan.yaml"))
    (folder / "part.yaml").write_text("dim: 5\n")  # which one.yaml names, and so does the prior of two
    problems = [outcome.problem for _, outcome in run_cells(cells, setting(folder), workers=1)]
    assert len(problems) == 2
    assert all("one.yaml" in problem for problem in problems)
    assert not (folder / "calls").exists()
    assert len(run(folder)) == 2


def test_a_checkpoint_is_tested_in_the_folder_that_the_plan_names(folder: Path) -> None:
    (folder / "plan.yaml").write_text("corpora: {tiny: {}}\nmethods: {old: {checkpoint: old.ckpt}}\n")
    (folder / "old.ckpt").write_text("old")
    cells = cells_of(read_plan(folder / "plan.yaml"))
    list(run_cells(cells, setting(folder, roots={"tiny": "/there"}), workers=1))
    assert [each["data.root"] for each in calls(folder)] == ["/there"]


def test_another_protocol_tests_again_and_trains_nothing(folder: Path) -> None:
    (folder / "plan.yaml").write_text(ONE_SEED)
    run(folder)
    before = len([each for each in calls(folder) if each["command"] == "fit"])
    (folder / "plan.yaml").write_text(ONE_SEED + "protocol: codetalker\n")
    assert len(run(folder)) == 2
    assert len([each for each in calls(folder) if each["command"] == "fit"]) == before


@pytest.mark.parametrize("step", ["fit", "test"])
def test_a_cell_that_fails_stops_no_other_and_says_why(folder: Path, step: str) -> None:
    key = "options" if step == "fit" else "test_options"
    failing = ONE_SEED.replace("one: {config: one.yaml}", f"one: {{config: one.yaml, {key}: {{trainer.fail: {step}}}}}")
    (folder / "plan.yaml").write_text(failing)
    assert len(run(folder)) == 2
    results = [read_result(cell_file(folder / "out", cell)) for cell in cells_of(read_plan(folder / "plan.yaml"))]
    problems = [result.problem for result in results if result is not None and result.problem]
    assert len(problems) == 1
    assert all("model.dim 0: made to fail" in problem for problem in problems)
    assert "made to fail" in report(folder)
    assert run(folder) == []
    assert len(run(folder, retry_failed=True)) == 1


def begin(folder: Path) -> subprocess.Popen[bytes]:
    """Run the plan in a process that can be killed."""
    program = (
        "import sys; from pathlib import Path; from tests.benchmark.test_running import run\n"
        "if __name__ == '__main__': run(Path(sys.argv[1]))"
    )
    (folder / "main.py").write_text(program)
    environment = {**os.environ, "STAND_IN_WAITS": "1"}
    words = [sys.executable, folder / "main.py", folder]
    return subprocess.Popen(words, cwd=Path(__file__).parents[2], env=environment)


def is_running(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except FileNotFoundError:
        return False
    return state != "Z"


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes")
@pytest.mark.slow
def test_killed_and_started_again_the_table_is_that_of_another_benchmark_with_the_same_seeds(folder: Path) -> None:
    process = begin(folder)
    trained = folder / "out" / "runs"
    wait_until(lambda: list(trained.rglob("last.ckpt")))
    (call,) = calls(folder)
    process.send_signal(signal.SIGKILL)
    process.wait()
    wait_until(lambda: not is_running(call["pid"]))  # the training ends with whoever started it
    assert len(run(folder)) == 4
    again = calls(folder)[1]
    assert (again["command"], again["name"], again["continues"]) == ("fit", call["name"], True)
    killed = report(folder)
    os.rename(folder / "out", folder / "killed")
    run(folder)
    assert report(folder) == killed


def test_the_best_weights_are_not_replaced_by_the_last(folder: Path) -> None:
    cell = next(cell for cell in cells_of(read_plan(folder / "plan.yaml")) if cell.row == "two")
    runner = Runner(setting(folder, weights="best"), folder / "out", cell)
    for training in cell.trainings:
        place = folder / "out" / training.name
        (place / LAST).parent.mkdir(parents=True)
        (place / LAST).touch()
        (place / STATE).write_text('{"done": true}')
    prior, scored = cell.trainings
    assert runner.fit(prior, {}, cell) == folder / "out" / prior.name / LAST  # which may have no score
    with pytest.raises(FaceDiffError, match=r"two.yaml wrote no best.ckpt.*weights: last"):
        runner.fit(scored, {}, cell)
    (folder / "out" / scored.name / BEST).touch()
    assert runner.fit(scored, {}, cell).name == "best.ckpt"
