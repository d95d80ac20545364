"""Plans: what is wrong with one is said in a sentence before anything runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from facediff.benchmark import cells_of, read_plan
from facediff.benchmark.plan import check_scores, find_plan
from facediff.cli.benchmark import corpus_folders
from facediff.errors import FaceDiffError
from facediff.utils.files import config_dir
from tests.benchmark.conftest import PLAN

WRONG: Sequence[tuple[str, str, str]] = (
    ("seeds: [0, 1]\n", "", "seeds"),
    ("corpora: {tiny: {}}", "corpora: {}", "corpora"),
    ("corpora: {tiny: {}}", "corpora: {tiny: {root: nowhere}}", "nowhere"),
    ("config: one.yaml}", "config: missing.yaml}", "missing.yaml"),
    ("one: {config: one.yaml}", "one: {}", "one"),
    ("one: {config: one.yaml}", "one: {checkpoint: a.ckpt}", "a.ckpt"),
    ("one: {config: one.yaml}", "one: {checkpoint: .}", "config.json"),  # a folder that is no model
    ("one: {config: one.yaml}", "one: {predictions: .}", "."),
    ("one: {config: one.yaml}", "one: {config: one.yaml, options: {--model.dim: 3}}", "--model.dim"),
    ("one: {config: one.yaml}", "one: {config: one.yaml, options: {seed_everything: 3}}", "seed_everything"),
    ("baseline: one", "baseline: three", "three"),
    ("baseline: one", "basline: one", "basline"),
    ("baseline: one", "references: [moving]", "moving"),
)


def test_a_bad_plan_meets_one_sentence(folder: Path) -> None:
    for old, new, named in WRONG:
        assert old in PLAN
        (folder / "plan.yaml").write_text(PLAN.replace(old, new, 1))
        with pytest.raises(FaceDiffError) as caught:
            cells_of(read_plan(folder / "plan.yaml"))
        assert named in str(caught.value), new
    assert not (folder / "out").exists()


def test_the_plan_of_the_manual_is_accepted(folder: Path) -> None:
    page = (Path(__file__).parents[2] / "docs" / "benchmark.md").read_text()
    (text,) = re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)
    corpus, predictions = folder / "BIWI", folder / "out" / "theirs"
    (folder / "codetalker.ckpt").write_bytes(b"a model")
    for place in (corpus, predictions):
        place.mkdir(parents=True)
    np.save(predictions / "F2_e37.npy", np.zeros((2, 3), np.float32))
    (folder / "plan.yaml").write_text(text)
    plan = read_plan(folder / "plan.yaml", {"biwi": corpus})
    assert {cell.row for cell in cells_of(plan)} == {"ours", "faceformer", "codetalker", "imported", "theirs"}
    assert len(cells_of(plan)) == sum(method.count_cells(plan) for method in plan.methods.values())


def test_a_root_overrides_the_plans_and_must_be_one_of_its_corpora(folder: Path) -> None:
    (folder / "here").mkdir()
    (cell, *_) = cells_of(read_plan(folder / "plan.yaml", corpus_folders([f"tiny={folder / 'here'}"])))
    assert cell.root == folder / "here"
    for words in (["tiny"], ["=x"], ["tiny=a", "tiny=b"]):
        with pytest.raises(FaceDiffError, match="--root"):
            corpus_folders(words)
    with pytest.raises(FaceDiffError, match="huge"):
        read_plan(folder / "plan.yaml", {"huge": folder})


@pytest.mark.parametrize("path", sorted((config_dir() / "benchmark").glob("*.yaml")), ids=lambda path: path.stem)
def test_plans_that_come_with_facediff_can_be_run(path: Path) -> None:
    plan = read_plan(path)
    check_scores(plan)
    assert len(cells_of(plan)) == sum(method.count_cells(plan) for method in plan.methods.values())


@pytest.mark.parametrize("count", [100, 101])
def test_a_plan_of_too_many_cells_is_refused_before_they_are_made(count: int, folder: Path) -> None:
    seeds, variants = [*range(count)], {f"v{number}": {} for number in range(50)}
    text = PLAN.replace("seeds: [0, 1]\n", f"seeds: {seeds}\nvariants: {variants}\n")
    (folder / "plan.yaml").write_text(text)
    if count > 100:
        with pytest.raises(FaceDiffError, match="makes 10100 cells with the other methods, of 10000 at most"):
            read_plan(folder / "plan.yaml")
    else:
        read_plan(folder / "plan.yaml")


@pytest.mark.parametrize(
    ("line", "named"),
    [
        ("columns: [lve, difference_ratio_mouth]", "difference_ratio_mouth"),
        ("columns: [lip_closure_error]", "lip_closure_error"),  # a metric that the plan does not ask for
        ("metrics: [lip_closing]", "lip_closing"),
        ("protocol: papers", "papers"),
        ("published: [nowhere]", "nowhere"),
    ],
)
def test_a_score_or_table_that_there_is_not_is_named(folder: Path, line: str, named: str) -> None:
    (folder / "plan.yaml").write_text(f"{PLAN}{line}\n")
    plan = read_plan(folder / "plan.yaml")
    with pytest.raises(FaceDiffError, match=rf"plan\.yaml.*{named}"):
        check_scores(plan)


@pytest.mark.parametrize("name", ["quick", "quick.yaml", "configs/benchmark/quick.yaml"])
def test_a_plan_of_the_package_is_found_from_any_folder(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert find_plan(Path(name)).samefile(config_dir() / "benchmark" / "quick.yaml")
