"""Figures of papers: where they may stand next to ours, and that they are the printed ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from facediff.benchmark.cells import cells_of, config_content, rows_of
from facediff.benchmark.plan import read_plan
from facediff.benchmark.published import published, shown_tables
from facediff.benchmark.running import fit_options, option_words
from facediff.cli.benchmark import data_class
from facediff.cli.lightning import parse_fit
from facediff.data import vocaset
from facediff.utils.files import config_dir

BIWI: dict[str, Any] = {
    "rows": {"ours": "FaceFormer"},
    "corpus": "biwi",
    "synthetic": False,
    "split": "test_a",
    "protocol": "paper",
    "lips": {"count": 4996},
    "frames": 3879,
    "sequences": 24,
}


def test_figures_of_papers_stand_next_to_ours_only_where_all_agrees() -> None:
    shown = shown_tables(["dual_path_biwi"], **BIWI)
    assert shown.scores == {"ours": {"mve": 7.1767e-3, "lve": 5.1780e-4, "fdd": 5.0296e-5}}
    assert not shown.reasons
    for key, value in (
        ("corpus", "puppet"), ("split", "test_b"), ("protocol", "codetalker"), ("lips", {"count": 250}),
        ("frames", 3878), ("sequences", 23),
    ):  # fmt: skip
        other = shown_tables(["dual_path_biwi"], **{**BIWI, key: value})
        assert not other.scores
        assert len(other.reasons) == 1, key
    doubted = shown_tables(["dual_path_vocaset"], **{**BIWI, "corpus": "vocaset", "split": "test_b"})
    assert "lip vertices" in doubted.reasons[0]


def test_printed_figures_are_those_of_the_page_on_definitions() -> None:
    words = (Path(__file__).parents[2] / "docs" / "which_lve.md").read_text()
    line = next(line for line in words.splitlines() if line.startswith("| the paper's method | 6.5194"))
    wanted = [float(cell) for cell in line.split("|")[2:-1]]
    paper = "the paper's method"
    biwi, mead, voca = (published()[f"dual_path_{name}"].rows[paper] for name in ("biwi", "mead3d", "vocaset"))
    scaled = [biwi["mve"] * 1e3, biwi["lve"] * 1e4, biwi["fdd"] * 1e5]
    scaled += [mead["mve"] * 1e3, mead["lve"] * 1e4, mead["fdd"] * 1e7, voca["lve"] * 1e5]
    assert scaled == pytest.approx(wanted)


CLIPS = {
    "biwi": [f"{speaker}_e{number:02d}" for speaker in ("F1", "F2", "F3", "F4", "M1", "M3") for number in range(1, 41)],
    "vocaset": [f"{speaker}_sentence{n:02d}" for speaker in (*vocaset.TRAIN, *vocaset.TEST) for n in range(1, 41)],
    "mead3d": [
        f"{s}_{n:03d}_{e}_{0 if e == 0 else 1}" for s in ("M003", "M030") for n in range(1, 41) for e in range(8)
    ],
}
"""Names of clips of each corpus, of speakers and sentences for training and tests."""


@pytest.mark.parametrize("path", sorted((config_dir() / "benchmark").glob("*.yaml")), ids=lambda path: path.stem)
def test_the_data_of_a_plan_have_the_split_of_the_figures_that_it_quotes(path: Path, tmp_path: Path) -> None:
    plan = read_plan(path)
    tables = [published()[name] for name in plan.published]
    rows = {row.name: row.published for row in rows_of(plan)}
    parsed: set[str] = set()
    for cell in cells_of(plan):
        table = next((table for table in tables if table.corpus == cell.corpus and rows[cell.row] in table.rows), None)
        if table is None or not cell.trainings:
            continue
        training = cell.trainings[-1]
        options = {name: value for name, value in fit_options(training, {}, cell).items() if name.startswith("data")}
        words = ["--config", str(training.config), *option_words({**options, "data.root": "nowhere"})]
        if (data_words := f"{config_content(training.config)['data']} {words[2:]}") in parsed:
            continue
        parsed.add(data_words)
        _, (class_path, arguments) = parse_fit(words)
        data = data_class(class_path)(**{**arguments, "root": str(tmp_path)})
        clips = [clip for name in CLIPS[cell.corpus] if (clip := data.parse_name(name)) is not None]
        assert table.split in {data.split_of(clip) for clip in clips}, (cell.row, training.config)
    assert bool(parsed) == bool(tables)
