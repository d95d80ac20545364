"""Figures of papers: where they may stand next to ours, and that they are the printed ones."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from facediff.benchmark.published import published, shown_tables

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
