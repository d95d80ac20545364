"""Commands in a base install: those that need more name the extra that brings it, in one sentence."""

from __future__ import annotations

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import numpy as np
import pytest
import soundfile

from facediff.cli.app import COMMANDS

ROOT = Path(__file__).parents[2]
EXTRAS = {
    "demo -o demo": "train,puppet,render",
    "animate a.wav --checkpoint c.ckpt -o a.npz": "train",
    "animate a.wav --style a.mp4 -o a.npz": "prepare,render,onnx",
    "person a.mp4 -o b.ckpt": "prepare,render,onnx",
    "data track a.mp4 -o people": "prepare,render,onnx",
    "live c.ckpt a.wav --to jsonl:-?weights=false": "train",
    "adapt --checkpoint c.ckpt --person p -o b.ckpt": "train",
    "publish c.ckpt published": "train",
    "export-model c.ckpt -o onnx": "onnx",
    "serve p": "serve",
    "import-checkpoint c.ckpt -o i.ckpt": "train",
    "style extract a.npy --checkpoint c.ckpt -o s.npy": "train",
    "view a.npy --mesh m.obj --frame-rate 25 -o a.html": "",
    "export a.npy --mesh m.obj --frame-rate 25 --unit m -o a.glb": "",
    "export a.npy --mesh m.obj --frame-rate 25 --unit m -o a.mp4": "render",
    "export a.npy --mesh m.obj --frame-rate 25 --unit m -o a.usdc": "usd",
    "fit --help": "train",
    "validate --ckpt_path c.ckpt": "train",
    "test --ckpt_path c.ckpt": "train",
    "predict --ckpt_path c.ckpt": "train",
    "evaluate p t": "train",
    "benchmark plan -o bench": "train",
    "benchmark report bench": "train",
    "benchmark referee": "train,puppet",
    "generation-metrics c.ckpt": "train",
    "figure lips p t -o f.png": "figures",
    "study make a=p b=t -o study": "study",
    "study serve p": "study",
    "data check p": "train",
    "data pack p packed": "packed",
    "data unpack p unpacked": "packed",
    "data import-person a.wav --audio a.wav --name x --corpus p --output o --frame-rate 25": "prepare",
    "components": "train",
    "check-install": "",
}
"""Command lines, and the extra that a base install lacks for them; empty where it lacks nothing."""

# All that a base install does not have cannot be imported; what is printed of each command follows its number.
BARE = """
import contextlib, importlib.metadata, io, re, sys
from facediff.cli.app import main

def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()

installed = set()
def add(name):
    if normal(name) not in installed:
        installed.add(normal(name))
        for need in importlib.metadata.requires(name) or []:
            if "extra ==" not in need:
                with contextlib.suppress(importlib.metadata.PackageNotFoundError):
                    add(re.match(r"[A-Za-z0-9._-]+", need)[0])

for name in sys.argv[1].split(","):
    add(name)
for module, owners in importlib.metadata.packages_distributions().items():
    if module != "facediff" and not {normal(owner) for owner in owners} & installed:
        sys.modules[module] = None
for number, line in enumerate(sys.stdin):
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        status = main(line.split())
    print(number, status, " ".join(errors.getvalue().split()))
"""


@pytest.fixture(scope="module")
def printed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[int, str]]:
    """Exit status and error of every command line, in one process that has the base install's packages only."""
    folder = tmp_path_factory.mktemp("base")
    soundfile.write(folder / "a.wav", np.zeros(16_000), 16_000)
    np.save(folder / "a.npy", np.stack([np.eye(4, 3, -1, dtype=np.float32)] * 10))
    (folder / "m.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 3 4\n")
    for name in ("c.ckpt", "plan", "a.mp4"):
        (folder / name).write_text("x")
    for name in ("p", "t"):
        (folder / name).mkdir()
        np.save(folder / name / "F1_01.npy", np.zeros((10, 4, 3), np.float32))
    dependencies = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    base = ",".join(re.split(r"[\[<>=]", need)[0] for need in dependencies)
    run = subprocess.run(
        [sys.executable, "-c", BARE, base],
        input="\n".join(EXTRAS),
        capture_output=True,
        text=True,
        cwd=folder,
        timeout=250,
        env={"PYTHONPATH": str(ROOT), "PATH": "/usr/bin:/bin"},
    )
    assert run.returncode == 0, run.stderr
    rows = [line.split(" ", 2) for line in run.stdout.splitlines()]
    return {line: (int(status), error) for line, (_, status, error) in zip(EXTRAS, rows, strict=True)}


def test_every_missing_extra_is_named(printed: dict[str, tuple[int, str]]) -> None:
    wrong = [
        f"{line}: {status} {error}"
        for line, (status, error) in printed.items()
        if (f'pip install "facediff[{EXTRAS[line]}]"' in error, status) != ((True, 2) if EXTRAS[line] else (False, 0))
    ]
    assert not wrong, "\n".join(wrong)


def test_the_extras_of_commands_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert {extra for command in COMMANDS.values() for extra in command.extra.split(",")} <= set(extras)
