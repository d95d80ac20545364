"""What commands print: names of files hold anything, and a terminal obeys some of it."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

import facediff
from facediff.cli.process import tell

COMMANDS = sorted((Path(facediff.__file__).parent / "cli").glob("*.py"))


def calls(path: Path, name: str) -> list[ast.Call]:
    found = [node for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Call)]
    return [call for call in found if ast.unparse(call.func) == name]


def test_lines_hold_nothing_that_a_terminal_obeys(capsys: pytest.CaptureFixture[str]) -> None:
    tell("written: a\x1b[2J\nb\udcff.npy", Path("ä.npy"))
    assert capsys.readouterr().out.splitlines() == ["written: a\\x1b[2J\\nb\\udcff.npy", "ä.npy"]


@pytest.mark.parametrize("path", [path for path in COMMANDS if path.name != "process.py"], ids=lambda path: path.name)
def test_commands_print_by_one_function(path: Path) -> None:
    assert [call.lineno for call in calls(path, "print") if all(word.arg != "file" for word in call.keywords)] == []


@pytest.mark.slow
def test_json_is_written_without_numbers_that_it_does_not_know() -> None:
    package = Path(facediff.__file__).parent
    writers = ("animation", "cli", "data", "editing", "evaluation", "export", "pipelines", "render")
    loose = [
        f"{path.name}:{call.lineno}"
        for folder in writers
        for path in sorted((package / folder).rglob("*.py"))
        for name in ("json.dumps", "json_format.dumps", "json.dump")
        for call in calls(path, name)
        if all(word.arg != "allow_nan" for word in call.keywords)
    ]
    # What is parsed again in the same process, or compared only.
    assert {entry.partition(":")[0] for entry in loose} == {"lightning.py", "preparation.py", "folder.py"}
