import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "benchmarks" / "training.py"
TOY = (
    "--vertices 30 --clips 4 --frames 12 --max-frames 60 --dim 16 --layers 1 --heads 2 --frozen 2 --rounds 1 "
    "--single 1 --curve-steps 2 --threads 1 --tiny-encoder --no-memory"
)

Output = tuple[str, dict[str, Any]]


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> Output:
    """What a toy run prints, and its unrounded numbers."""
    numbers = tmp_path_factory.mktemp("training") / "numbers.json"
    command = [sys.executable, SCRIPT, *TOY.split(), "--json", numbers]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout, json.loads(numbers.read_text())


def test_every_ratio_follows_from_what_was_counted(output: Output) -> None:
    text, numbers = output
    rows = numbers["turns"]["2"]
    assert next(iter(rows)) == "peers"
    printed = [line for line in text.splitlines() if re.match(r"(peers|\+ [a-z0-9 -]+?)  +\d", line)]
    assert len(printed) == len(rows) == 6
    peers = rows["peers"]
    for line, (name, row) in zip(printed, rows.items(), strict=True):
        assert line.startswith(name)
        cells = [float(word) for word in line[len(name) :].split()]
        assert cells[0] == pytest.approx(row["clips"] / row["seconds"], rel=1e-3, abs=1e-3)
        assert cells[3] == pytest.approx(cells[0] / (peers["clips"] / peers["seconds"]), abs=0.01)
        assert cells[4] == pytest.approx(row["clips"] / row["busy"] * peers["busy"] / peers["clips"], abs=0.01)
        # Single clips for the first three ways, several a batch for the others.
        assert (row["clips"] == 1) == (name in list(rows)[:3])


def test_loss_curves_by_batches_and_clip_by_clip_are_one(output: Output) -> None:
    text, numbers = output
    curves = numbers["curves"]
    assert len(curves["clip by clip"]) == 2
    assert curves["float32"] == pytest.approx(curves["clip by clip"], rel=1e-5)
    assert curves["bf16-mixed"] == pytest.approx(curves["clip by clip"], rel=3e-2)
    assert curves["bf16-mixed"] != curves["float32"]
    assert "BEYOND" not in text


def test_the_machine_is_named(output: Output) -> None:
    assert "machine: " in output[0]
    assert "1 threads; device cpu" in output[0]
