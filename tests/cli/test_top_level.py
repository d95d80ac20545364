"""The top level of the command line: quick, and helpful when a word is wrong."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from facediff.cli.app import COMMANDS, GROUPS, main, usage
from facediff.registry import KINDS

# Every command line in one process; after each, whether anything heavy has been loaded.
SPY = """
import contextlib, io, json, sys
from facediff.cli.app import main
for line in json.loads(sys.argv[1]):
    errors = io.StringIO()
    with contextlib.redirect_stderr(errors), contextlib.redirect_stdout(io.StringIO()):
        try:
            status = main(line.split())
        except SystemExit as end:
            status = end.code
    heavy = [name for name in sys.argv[2:] if name in sys.modules]
    print(json.dumps([status, heavy, len(errors.getvalue().splitlines())]))
"""


def spied(lines: list[str], heavy: list[str], folder: Path) -> dict[str, tuple[int, list[str], int]]:
    """Status, heavy modules and lines of errors by command line."""
    command = [sys.executable, "-c", SPY, json.dumps(lines), *heavy]
    run = subprocess.run(command, capture_output=True, text=True, check=True, cwd=folder)
    return dict(zip(lines, map(json.loads, run.stdout.splitlines()), strict=True))


MISTAKES = [
    "animate",
    "animate --bad",
    "animate missing.wav --checkpoint x.ckpt -o y.mp4",
    "animate - -o y.npy --checkpoint x.ckpt",
    "adapt --checkpoint missing.ckpt --person a -o b.ckpt",
    "style extract a --checkpoint missing.ckpt -o a.npy",
    "view missing.npz -o a.html",
    "export --sise 3",
    "export missing.npz -o a.glb",
    "blendshapes missing.npz -o a.csv --shapes missing",
    "retarget missing.npz --target-mesh missing.obj -o a.npz",
    "evaluate missing truth",
    "figure lips missing truth -o a.png",
    "data check missing",
    "data import-person missing --audio a --name b --corpus c -o d --frame-rate 25",
    "study make missing other -o a",
    "study make a=. --truth missing -o a",
    "study serve missing --prot 3",
    "study report",
    "study report missing",
    "study report a --level 7",
    "components samplr",
    "demo --epoch 3",
]


def test_help_and_mistakes_import_nothing_heavy(tmp_path: Path) -> None:
    rows = spied(["animate --help", "demo --help", *MISTAKES], ["torch", "lightning", "numpy"], tmp_path)
    wrong = {line: row for line, row in rows.items() if row != ([0, [], 0] if line.endswith("--help") else [2, [], 1])}
    assert not wrong


@pytest.mark.parametrize("group", ["", *GROUPS])
def test_the_help_keeps_names_and_texts_apart(group: str) -> None:
    rows = usage(group).partition("commands:\n")[2].partition("\n\n")[0].splitlines()
    assert [row for row in rows if re.fullmatch(r"  [a-z-]+( [a-z-]+)? {2,}\S.*", row) is None] == []
    assert len({len(row) - len(re.sub(r"^  [a-z-]+( [a-z-]+)? {2,}", "", row)) for row in rows}) == 1


def test_a_wrong_command_names_the_nearest_and_all(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["anmate"]) == 2
    message = capsys.readouterr().err
    assert 'did you mean "animate"?' in message
    assert all(name.split()[0] in message for name in COMMANDS)


@pytest.mark.parametrize("group", GROUPS)
def test_groups_list_their_commands(group: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([group]) == 2
    assert main([group, "--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name.split()[1]} " in text for name in COMMANDS if name.startswith(f"{group} "))
    assert main([group, "nothing"]) == 2
    assert f'"{group} nothing"' in capsys.readouterr().err


def test_components_lists_what_can_be_chosen(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["components", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert {"kind": "fusion", "name": "add"}.items() <= next(r for r in rows if r["name"] == "add").items()
    assert all(row["summary"] for row in rows)
    assert main(["components", "decoder"]) == 0
    text = capsys.readouterr().out
    assert "gru" in text
    assert "num_layers = " in text
    assert "ddim" not in text


def test_components_describes_the_options_that_metrics_share(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["components", "metric"]) == 0
    options = [line for line in capsys.readouterr().out.splitlines() if line.startswith("      ")]
    assert any(line.strip().startswith("length_rule = 'min': ") for line in options)
    assert [line for line in options if ": " not in line] == []


def test_components_lists_every_kind(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["components"]) == 0
    text = capsys.readouterr().out
    assert all(f"\n{kind.kind}: {kind.title}\n" in f"\n{text}" for kind in KINDS.values())
    assert all(f"  {entry.name} " in text for kind in KINDS.values() for entry in kind)


def test_a_reader_that_has_had_enough_is_no_error() -> None:
    command = [sys.executable, "-m", "facediff", "--help"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()  # before anything has been written
        assert process.stderr.read() == ""
        assert process.wait(60) == 141
