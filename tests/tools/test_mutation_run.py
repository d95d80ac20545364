"""The mutation run: which changes it makes, and that it tells a tested line from an untested one."""

from __future__ import annotations

import ast
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tools import mutants, mutation_run
from tools.mutants import Mutant, mutants_of

ROOT = Path(__file__).parents[2]
SOURCE = '''"""Distances."""

import math

HALF = 0.5


def distance(a: float, b: float) -> float:
    """√(a² + b²), or an error."""
    if a < 0:
        raise ValueError(f"{a + 1} is negative")
    return math.sqrt(a**2 + b**2)


def half(x: float) -> float:
    """Never called by a test."""
    return HALF * x

'''
TESTS = """
import pytest
from package.shapes import distance

@pytest.fixture(autouse=True)
def _nothing():  # what a test calls after its fixtures counts as well
    yield

def test_distance():
    assert distance(3, 4) == 5
"""


def changes(source: str) -> dict[str, list[Mutant]]:
    found: dict[str, list[Mutant]] = {}
    for mutant in mutants_of("file.py", source.encode()):
        found.setdefault(ast.unparse(ast.parse(mutant.applied(source.encode()))), []).append(mutant)
    return found


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("a + b", "a - b"),
        ("a - b", "b - a"),
        ("a * b", "a / b"),
        ("a + b * c", "a"),
        ("a + b * c", "b * c"),
        ("x.mean(-1)", "x.sum(-1)"),
        ("x.mean(-1)", "x.mean(-2)"),
        ("x.square().sqrt()", "x.square()"),
        ("torch.tanh(x)", "x"),
        ("self.norm(x)", "x"),
        ("torch.minimum(x, y)", "torch.maximum(x, y)"),
        ("f(x, y)", "f(y, x)"),
        ("f(x, dim=1)", "f(x)"),
        ("x[1:]", "x[:]"),
        ("-x", "x"),
        ("2 * x", "3 * x"),
        ("0.5 * x", "1.0 * x"),
        ("a @ b", "b @ a"),
        ("a if b < c else d", "a if b <= c else d"),
        ("a if b < c else d", "a if b > c else d"),
        ("a if b else d", "a if not b else d"),
        ("a and b", "a or b"),
        ("a and b", "b"),
        ("f(True)", "f(False)"),
    ],
)
def test_terms_are_changed(before: str, after: str) -> None:
    text = "def g():\n    return {}\n"
    assert ast.unparse(ast.parse(text.format(after))) in changes(text.format(before))


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("x.transpose(1, 2)", "x.transpose(2, 1)"),
        ("F.huber_loss(x, y)", "F.huber_loss(y, x)"),
        ("(a - b).square()", "(b - a).square()"),
        ("(a - b).diff(dim=1).abs()", "(b - a).diff(dim=1).abs()"),
        ("torch.linalg.vector_norm(a - b)", "torch.linalg.vector_norm(b - a)"),
        ("(a - b) ** 2", "(b - a) ** 2"),
        ("checkpoint(f, preserve_rng_state=False)", "checkpoint(f, preserve_rng_state=True)"),
        ("checkpoint(f, preserve_rng_state=False)", "checkpoint(f)"),
        ("torch.sqrt(x, out=y)", "torch.sqrt(x)"),
    ],
)
def test_changes_without_effect_are_not_made(before: str, after: str) -> None:
    text = "def g():\n    return {}\n"
    assert ast.unparse(ast.parse(text.format(after))) not in changes(text.format(before))


@pytest.mark.parametrize("statement", ["x += y", "self.x = y", "x[0] = y", "f(x)", "continue"])
def test_statements_are_removed(statement: str) -> None:
    text = "def g():\n    for x in y:\n        {}\n"
    assert ast.unparse(ast.parse(text.format("pass"))) in changes(text.format(statement))


@pytest.mark.parametrize(
    "text",
    [
        '"""1 + 1"""',
        "def g(x: Float[Tensor, '2 3'] = y) -> A | B: return x",
        "import a",
        "def g():\n    raise E(1 + 1)",
        "def g():\n    return f'{a + 1} b'",
        "def g():\n    assert a + 1",
    ],
)
def test_texts_annotations_and_errors_are_left_alone(text: str) -> None:
    assert not changes(text)


def test_a_change_says_where_it_is() -> None:
    text = "X = 1\n\n\nclass Ärger:\n    def ü(self, n=2):\n        ß = lambda: (n + 3)\n        return ß\n"
    assert {(m.line, m.function) for m in mutants_of("file.py", text.encode())} == {
        (1, ""),
        (5, "Ärger.ü"),
        (6, "Ärger.ü"),
    }
    keys = [mutant.key for mutant in mutants_of("file.py", text.encode())]
    assert len(set(keys)) == len(keys)
    later = mutants_of("file.py", ("\n\n" + text).encode())
    assert [mutant.key for mutant in later] == keys  # lines elsewhere do not matter


def test_the_sample_follows_its_seed() -> None:
    files = ["facediff/models/losses.py", "facediff/models/samplers.py"]
    first, again, other = ([mutant.key for mutant in mutants.sample(ROOT, files, 20, seed)] for seed in (0, 0, 1))
    assert first == again != other
    assert len(set(first)) == 20


def test_a_sample_stays_when_other_lines_change(tmp_path: Path) -> None:
    """So that killing a survivor, or adding a file, does not make another sample of it."""
    (tmp_path / "a.py").write_text("".join(f"def f{i}(x):\n    return x + {i}\n\n" for i in range(30)))
    before = mutants.sample(tmp_path, ["*.py"], 40, 0)
    (tmp_path / "b.py").write_text("def g(x):\n    return 2 * x\n")
    after = mutants.sample(tmp_path, ["*.py"], 50, 0)
    assert [m.key for m in after if m.file == "a.py"][:40] == [m.key for m in before]


def test_what_hangs_is_ended() -> None:
    assert mutation_run.forked(lambda: time.sleep(60) or 0, 0.2) is None
    assert mutation_run.forked(lambda: 3, 60) == 3


@pytest.mark.slow
def test_tested_lines_kill_and_untested_ones_survive(tmp_path: Path) -> None:
    """The whole run on a package in miniature; a second call has nothing left to do."""
    project = tmp_path / "project"
    (project / "package").mkdir(parents=True)
    (project / "tests").mkdir()
    (project / "package" / "shapes.py").write_text(SOURCE)
    (project / "tests" / "test_shapes.py").write_text(TESTS)
    (project / "pyproject.toml").write_text('[tool.pytest.ini_options]\npythonpath = ["."]\n')
    words = ["--root", str(project), "--only", "package/*.py", "--tests", "tests", "--preload", "--without"]
    words += ["--state", str(tmp_path / "state"), "--count", "0"]
    command = [sys.executable, str(ROOT / "tools" / "mutation_run.py"), *words]
    run = subprocess.run(command, capture_output=True, text=True, check=False)
    assert run.returncode == 1, run.stderr  # some survive
    outcomes = [json.loads(line) for line in (tmp_path / "state" / "outcomes.jsonl").read_text().splitlines()]
    by_function: dict[str, set[str]] = {}
    for outcome in outcomes:
        by_function.setdefault(outcome["function"], set()).add(outcome["result"])
    assert by_function["half"] == {"not called"}
    assert by_function[""] == {"survived"}  # the constant that only `half` uses
    of_root = [o for o in outcomes if o["function"] == "distance" and "sqrt" in o["diff"]]
    assert {o["result"] for o in of_root} == {"killed"}
    assert {o["by"] for o in of_root} == {"tests/test_shapes.py::test_distance"}
    assert "survived" in by_function["distance"]  # that a negative length is refused is tested nowhere
    assert (project / "package" / "shapes.py").read_text() == SOURCE
    again = subprocess.run(command, capture_output=True, text=True, check=False)
    assert again.returncode == 1, again.stderr
    assert "survive" in again.stdout
    assert " s  package" not in again.stdout
    assert run.stdout.endswith(again.stdout)
