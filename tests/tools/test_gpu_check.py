"""The check of a machine with a GPU, at toy size on the processor."""

import importlib.util
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import pytest

SCRIPT = Path(__file__).parents[2] / "tools" / "gpu_check.py"


@pytest.fixture(scope="module")
def program() -> ModuleType:
    spec = importlib.util.spec_from_file_location("gpu_check", SCRIPT)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules["gpu_check"] = module
    spec.loader.exec_module(module)
    return module


class Parts:
    """Checks that do next to nothing: one passes, one fails, one breaks."""

    def __init__(self, program: ModuleType) -> None:
        self.row = program.Row

    def __getattr__(self, name: str) -> Callable[[], Iterator[object]]:
        def part() -> Iterator[object]:
            if name == "loader":
                raise RuntimeError("out of memory")
            yield self.row(name, "1", "2", name != "train")

        return part


def test_a_check_that_breaks_is_a_row_and_the_others_go_on(
    program: ModuleType, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = list(program.run(Parts(program), 60))
    assert [row.check for row in rows if row.passed is False] == ["train", "loader"]
    assert rows[-1].check == "tests"
    assert "| loader | RuntimeError: out of memory | runs | FAIL |" in program.table(rows, 3)
    assert program.table(rows, 3).endswith("4 passed, 2 failed.\n")


def test_what_there_is_no_time_for_is_named(program: ModuleType) -> None:
    rows = list(program.run(Parts(program), 1e-9))
    assert len(rows) == 6
    assert all(row.passed is False and "left out" in row.figure for row in rows)


@pytest.mark.slow
def test_without_cuda_the_same_runs_at_toy_size(tmp_path: Path) -> None:
    words = [sys.executable, SCRIPT, "-o", tmp_path / "report.md", "--device=cpu"]
    done = subprocess.run(words, capture_output=True, text=True, check=False, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "no CUDA" in done.stdout.splitlines()[0]
    report = (tmp_path / "report.md").read_text()
    for part in ("DDP on gloo", "bf16-mixed", "ddpm", "dpm_solver", "loading",
                 "tests that need CUDA"):  # fmt: skip
        assert part in report
    assert "FAIL" not in report
