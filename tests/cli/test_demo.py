"""The demo from end to end."""

from __future__ import annotations

import csv
import os
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.callbacks.outputs import METHOD_NAMES
from facediff.cli.app import main
from facediff.errors import FaceDiffError


def run_demo(folder: Path, *words: str) -> dict[tuple[str, str], float]:
    """The LVE of each split and method that the demo prints and writes."""
    done = subprocess.run(
        [sys.executable, "-m", "facediff", "demo", "-o", str(folder / "demo"), *words],
        capture_output=True,
        text=True,
        check=False,
        cwd=folder,
        env={**os.environ, "FACEDIFF_CACHE": str(folder / "cache")},
    )
    assert done.returncode == 0, done.stderr[-3000:]
    assert "SYNTHETIC corpus puppet" in done.stdout
    names = METHOD_NAMES | {"sample_mean": "model"}  # of the model, one sample for each clip
    assert all(name in done.stdout for name in names.values())
    for file in ("truth_and_prediction_test_a.mp4", "truth_and_prediction_test_b.mp4", "puppet.ckpt"):
        assert (folder / "demo" / file).stat().st_size > 10_000
    with (folder / "demo" / "test_scores.csv").open() as stream:
        return {(row["split"], row["method"]): float(row["lve"]) for row in csv.DictReader(stream)}


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_demo_learns_to_speak(tmp_path: Path) -> None:
    lve = run_demo(tmp_path)
    assert lve["test_a", "model"] <= 0.5 * lve["test_a", "still"]
    assert lve["test_a", "model"] <= 0.6 * lve["test_a", "shuffled"]
    assert lve["test_b", "model"] < lve["test_b", "still"]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_the_fast_demo_writes_the_same_files(tmp_path: Path) -> None:
    lve = run_demo(tmp_path, "--fast")
    assert lve["test_a", "model"] < lve["test_a", "still"]


def test_a_demo_that_was_stopped_continues(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[list[str]] = []

    def train(name: str, arguments: list[str]) -> None:
        asked.append([name, *arguments])
        raise FaceDiffError("enough")

    monkeypatch.setattr("facediff.cli.lightning.run_cli", train)
    last = tmp_path / "training" / "version_0" / "checkpoints" / "last.ckpt"
    for file in (None, last, tmp_path / "puppet.ckpt"):  # a new one, a stopped one, one that came to its end
        if file is not None:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.touch()
        assert main(["demo", "-o", str(tmp_path)]) == 2
    assert [words[-2:] == ["--ckpt_path", "last"] for words in asked] == [False, True, False]
