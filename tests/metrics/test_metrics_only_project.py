"""Another project uses the metrics alone, with everything else out of reach."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

ROOT = Path(__file__).parents[2]
PROJECT = ROOT / "docs" / "examples" / "metrics_only"

# Leaves an interpreter with the standard library, torch, torchmetrics and what these two require. Everything else is
# not there, to the import model and to those who ask which packages are installed.
BARE = """
import importlib.abc, importlib.metadata, re, runpy, sys

def required(name, found):
    key = re.sub(r"[-_.]+", "-", name).lower()
    if key in found:
        return
    try:
        wanted = importlib.metadata.requires(name)
    except importlib.metadata.PackageNotFoundError:
        return
    found.add(key)
    for line in wanted or []:
        if "extra ==" not in line:
            required(re.match(r"[A-Za-z0-9._-]+", line)[0], found)

kept = set()
for name in ("torch", "torchmetrics"):
    required(name, kept)
allowed = {"facediff", "__main__"} | set(sys.stdlib_module_names)
others = set()
for module, owners in importlib.metadata.packages_distributions().items():
    owners = {re.sub(r"[-_.]+", "-", owner).lower() for owner in owners}
    (allowed if owners & kept else others).add(module)

class Bare(importlib.abc.MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in others - allowed:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)
        return None

sys.meta_path.insert(0, Bare())
found = importlib.metadata.Distribution.from_name
def from_name(name):
    if re.sub(r"[-_.]+", "-", name).lower() not in kept:
        raise importlib.metadata.PackageNotFoundError(name)
    return found(name)
importlib.metadata.Distribution.from_name = staticmethod(from_name)

for name in {"lightning", "jsonargparse", "soundfile", "trimesh", "transformers"}:
    try:
        __import__(name)
    except ImportError:
        continue
    raise SystemExit(f"{name} is within reach")
sys.argv = sys.argv[1:]
runpy.run_path(sys.argv[0], run_name="__main__")
"""


@pytest.fixture
def files(tmp_path: Path) -> tuple[list[str], dict[str, float]]:
    """Two clips of four vertices as files, and their scores in NumPy: the command's words, and what it should print."""
    rng = np.random.default_rng(1)
    template = rng.normal(size=(4, 3)).astype(np.float32)
    np.save(tmp_path / "template.npy", template)
    (tmp_path / "lips.txt").write_text("2, 0, 2")
    (tmp_path / "upper.txt").write_text("1,3")
    largest: list[NDArray[np.floating]] = []
    deviations, correlations = [], []
    for name, frames in (("a_01", 5), ("b_01", 9)):
        truth = template + 0.1 * rng.normal(size=(frames, 4, 3)).astype(np.float32)
        prediction = template + 0.1 * rng.normal(size=(frames + 1, 4, 3)).astype(np.float32)
        for folder, motion in (("truths", truth), ("predictions", prediction)):
            (tmp_path / folder).mkdir(exist_ok=True)
            np.save(tmp_path / folder / f"{name}.npy", motion.reshape(len(motion), -1))
        g, p = truth.astype(np.float64), prediction[:frames].astype(np.float64)
        largest.append(((g - p) ** 2).sum(-1)[:, [0, 2]].max(1))
        spread = [((x - template) ** 2).sum(-1).std(0)[[1, 3]].mean() for x in (g, p)]
        deviations.append(spread[0] - spread[1])
        speeds = [np.linalg.norm(np.diff(x[:, [0, 2]], axis=0), axis=-1).mean(1) for x in (g, p)]
        correlations.append(np.corrcoef(*speeds)[0, 1])
    words = [str(tmp_path / n) for n in ("predictions", "truths", "template.npy", "lips.txt", "upper.txt")]
    scores = {"lve": np.concatenate(largest).mean(), "fdd": np.mean(deviations), "lip_pcc": np.mean(correlations)}
    return words, {name: float(score) for name, score in scores.items()}


def check(printed: str, scores: dict[str, float]) -> None:
    """Hold what the project printed against NumPy's figures."""
    for name, score in scores.items():
        found = re.search(rf"^{name}\s+(\S+)$", printed, re.MULTILINE)
        assert found, printed
        assert float(found[1]) == pytest.approx(score, rel=1e-5)
    assert "lips lips (2 vertices, " in printed
    assert "frames 14, sequences 2; frames cut: prediction 2, truth 0" in printed


def test_the_outside_project_runs_with_torch_and_torchmetrics_alone(files: tuple[list[str], dict[str, float]]) -> None:
    words, scores = files
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", BARE, str(PROJECT / "mouthscore.py"), *words],
        capture_output=True,
        text=True,
        timeout=120,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert run.returncode == 0, run.stderr
    check(run.stdout, scores)


def test_the_outside_project_asks_for_nothing_else() -> None:
    wanted = re.search(r"^dependencies = (.*)$", (PROJECT / "pyproject.toml").read_text(), re.MULTILINE)
    assert wanted
    assert re.findall(r"[a-z]\w+", wanted[1]) == ["facediff", "metrics", "numpy"]


def test_the_extra_asks_for_torch_and_torchmetrics_alone() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert [re.split("[>=<]", line)[0] for line in extras["metrics"]] == ["torch", "torchmetrics"]
