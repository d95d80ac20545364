"""``--scheduler``: where tasks run changes nothing that a command writes or prints."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from facediff.cli.app import load, main
from facediff.cli.data import options_of
from facediff.cli.parsing import flat, parameters_of
from facediff.data.prepare.biwi import plan

ROOT = Path(__file__).parents[2]
TINY = "tests.fakes.tiny.Tiny"
SHARED = ("animate", "benchmark", "data check", "evaluate", "study make")


@pytest.fixture
def place(tiny_root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a corpus, predictions and recordings, in which commands run."""
    corpus = shutil.copytree(tiny_root, tmp_path / "corpus")
    for folder in ("ours", "speech"):
        (tmp_path / folder).mkdir()
    for clip in ("A_e06", "A_e07"):
        truth = np.load(corpus / "vertices_npy" / f"{clip}.npy")
        np.save(tmp_path / "ours" / f"{clip}_condition_A.npy", truth + np.float32(0.001))
        shutil.copy(corpus / "wav" / f"{clip}.wav", tmp_path / "speech")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(out: str) -> list[list[str]]:
    """One of each sort, without a model."""
    return [
        ["evaluate", "ours", "corpus", "--bootstrap", "20", "--quiet", "--json", f"{out}/scores.json"],
        ["data", "check", "corpus", "--corpus", TINY, "--quiet"],
    ]


def written(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def test_the_option_is_the_same_in_every_command() -> None:
    found = {}
    for command in SHARED:
        (found[command],) = (each for each in flat(parameters_of(load(command))) if each.name == "scheduler")
    (found["data prepare"],) = (each for each in flat(options_of(plan)) if each.name == "scheduler")
    assert len(set(map(str, found.values()))) == 1, found


def test_a_wrong_place_is_refused_before_any_work(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("ours", "corpus"):
        (tmp_path / name).mkdir()
    monkeypatch.chdir(tmp_path)
    for words in commands("out"):
        assert main([*words, "--scheduler", "dask"]) == 2
        assert "--scheduler dask" in capsys.readouterr().err


def test_threads_write_what_is_written_without_the_option(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    printed = []
    for out, more in (("usual", []), ("other", ["--scheduler", "threads", "--workers", "3"])):
        for words in commands(out):
            assert main([*words, *more]) == 0
        printed.append(capsys.readouterr().out.replace(out, ""))
    assert written(place / "usual") == written(place / "other")
    assert len(written(place / "usual")) == 1
    assert printed[0] == printed[1]


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_cluster_of_other_processes_writes_the_same(
    place: Path, checkpoint: Path, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With one of its two workers killed between the commands."""
    distributed = pytest.importorskip("distributed")
    animate = ["animate", "speech", "--checkpoint", str(checkpoint), "--suffix", ".npz", "--quiet", "-o"]
    monkeypatch.chdir(tmp_path_factory.mktemp("cluster"))
    with distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        printed = {}
        for out, where in (("here", "processes"), ("there", cluster.scheduler_address)):
            printed[out] = ""
            for words in [*commands(out), [*animate, f"{out}/motion"]]:
                environment = {**os.environ, "PYTHONPATH": str(ROOT)}
                command = [sys.executable, "-m", "facediff", *words, "--scheduler", where, "--workers", "2"]
                done = subprocess.run(command, cwd=place, env=environment, capture_output=True, text=True, timeout=250)
                assert done.returncode == 0, done.stderr
                if "animate" not in words:  # which prints seconds
                    printed[out] += done.stdout.replace(out, "")
                if out == "there" and "evaluate" in words:
                    os.kill(cluster.workers[1].pid, signal.SIGKILL)
    assert written(place / "here") == written(place / "there")
    assert len(list((place / "there" / "motion").glob("*.npz"))) == 2
    assert printed["here"] == printed["there"]
