"""The top level of the command line: quick, and helpful when a word is wrong."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from facediff.cli.app import COMMANDS, main

SPY = (
    "import sys; from facediff.cli.app import main; status = main(sys.argv[1:]); "
    "print([m for m in ('torch', 'lightning', 'numpy', 'jsonargparse') if m in sys.modules]); sys.exit(status)"
)


@pytest.mark.parametrize(("words", "status"), [(["--help"], 0), ([], 2), (["fitt"], 2), (["--version"], 0)])
def test_the_top_level_imports_nothing_heavy(words: list[str], status: int) -> None:
    done = subprocess.run([sys.executable, "-c", SPY, *words], capture_output=True, text=True, check=False)
    assert done.returncode == status
    assert done.stdout.splitlines()[-1] == "[]"


@pytest.mark.parametrize("words", [["animate", "--help"], ["demo", "--help"], ["animate"], ["animate", "--bad"]])
def test_our_own_subcommands_answer_without_torch(words: list[str]) -> None:
    spy = SPY.replace(
        "status = main(sys.argv[1:])",
        "import atexit; atexit.register(lambda: print([m for m in "
        "('torch', 'lightning') if m in sys.modules])); status = main(sys.argv[1:])",
    )
    done = subprocess.run([sys.executable, "-c", spy, *words], capture_output=True, text=True, check=False)
    assert done.returncode == (0 if "--help" in words else 2)
    assert done.stdout.splitlines()[-1] == "[]"


def test_a_wrong_command_names_the_nearest_and_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anmate"]) == 2
    message = capsys.readouterr().err
    assert 'did you mean "animate"?' in message
    assert all(name in message for name in COMMANDS)


def test_components_lists_what_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["components", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {"kind": "fusion", "name": "add"}.items() <= next(r for r in rows if r["name"] == "add").items()
    assert all(row["summary"] for row in rows)
    assert main(["components", "decoder"]) == 0
    text = capsys.readouterr().out
    assert "gru" in text
    assert "ddim" not in text


def test_a_reader_that_has_had_enough_is_no_error() -> None:
    command = [sys.executable, "-m", "facediff", "components"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()  # before a word of it has been written
        assert process.stderr.read() == ""
        assert process.wait(60) == 141
