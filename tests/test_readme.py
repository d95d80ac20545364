"""What the README promises: its files exist, its commands parse, its Python runs."""

from __future__ import annotations

import doctest
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image

from facediff.cli.app import COMMANDS, GROUPS, main

ROOT = Path(__file__).parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```sh\n(.*?)```", README, re.DOTALL)
FITS = [shlex.split(line, comments=True) for block in BLOCKS for line in block.splitlines() if "facediff fit" in line]


def test_the_two_commands_are_there() -> None:
    assert "pip install . && facediff animate --example -o speech.html" in README
    assert 'pip install -c tools/constraints.txt -e ".[all,test]" && pytest' in README


def test_every_command_exists() -> None:
    command = re.compile(r"^(?:.*&& )?facediff ([\w-]+)(?: ([\w-]+))?", re.MULTILINE)
    calls = [call for block in BLOCKS for call in command.findall(block)]
    assert len(calls) >= 6
    assert {f"{first} {second}" if first in GROUPS else first for first, second in calls} <= COMMANDS.keys()


@pytest.mark.parametrize("words", FITS, ids=lambda words: words[-1])
def test_fit_commands_parse(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([*words[1:], "--print_config"])
    assert stop.value.code == 0
    assert "class_path: facediff.models." in capsys.readouterr().out


def test_the_first_screen_has_the_picture_and_python() -> None:
    lines = README.splitlines()
    assert next(number for number, line in enumerate(lines, 1) if line.startswith("![")) <= 12
    assert lines.index("```python") < 30
    picture = ROOT / "docs" / "images" / "talking_face.webp"
    assert picture.name in README
    assert picture.stat().st_size < 1_500_000
    with Image.open(picture) as image:
        assert getattr(image, "n_frames", 1) > 20


def test_the_python_of_the_readme_runs() -> None:
    failed, attempted = doctest.testfile(str(ROOT / "README.md"), module_relative=False)
    assert attempted >= 4
    assert failed == 0
