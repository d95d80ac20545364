"""The commands of the manual, of the README and of the examples.

Commands of facediff are parsed by the parser that runs them, with the configs and classes that the pages themselves
print and with stand-ins for files; commands that train, score or animate on the pages of the tutorials run in
``test_tutorials.py``, and those of the example package in ``tests/test_outside_project.py``. Programs of ``tools/`` are
looked up with their options. What belongs to other projects (pip, arecord, blender …) is not run.
"""

from __future__ import annotations

import re
import shlex
import sys
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest

from facediff.cli.app import COMMANDS, find, load
from facediff.cli.lightning import checked_words, parse_fit
from facediff.cli.parsing import arguments_of
from facediff.errors import FaceDiffError

ROOT = Path(__file__).parents[2]
PAGES = sorted([*(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md"), *(ROOT / ".github").glob("*.md")])
FENCE = re.compile(r"^ *```(\w*)\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
VERBS = ("fit", "validate", "test", "predict")
OWN_PARSERS = ("run", "lightning")
PLACES = re.compile(r"\b(FIGURE|CHECKPOINT|FOLDER|SWEEP|TEAM)\b|…|\$\{?\w+|<")
"""Words that stand for something else: such a line is a form, not a command."""

MODULES = {"tutorial_research.md": "my_method", "losses.md": "my_losses", "own_data.md": "multiface"}
"""The file that a page has its first block of Python saved as."""

TRIED_QUICKLY = ("tutorial_research.md", "losses.md", "own_data.md", "packed.md", "examples")
"""Pages whose trainings are parsed in the quick suite; all others are with ``pytest -m slow``."""


def lines_of(page: Path) -> Iterator[str]:
    """The command lines of a page, without prompts and with continued lines joined."""
    for language, block in FENCE.findall(page.read_text(encoding="utf-8")):
        if language in ("console", "sh", ""):
            joined = re.sub(r" *\\\n\s*", " ", block)
            marked = re.findall(r"^\s*\$ (.*)$", joined, re.MULTILINE)
            yield from marked or joined.splitlines()


def words_of(line: str) -> list[str]:
    """The words of one program's call, without what a shell does around it."""
    try:
        words = shlex.split(line, comments=True)
    except ValueError:
        return []
    for stop in ("|", "&&", ";", ">", "done"):
        if stop in words:
            words = words[: words.index(stop)]
    return words


def calls(program: str) -> list[tuple[Path, list[str]]]:
    """Every call of a program on the pages, by page; of a pipe or a list, each part."""
    found = []
    for page in PAGES:
        for line in lines_of(page):
            for part in re.split(r"\s(?:\||&&|do)\s+", line.strip()):
                words = words_of(part)
                if words[:1] == [program] and not PLACES.search(part.partition(" #")[0]):
                    found.append((page, words[1:]))
    return found


FACEDIFF = calls("facediff")
FITS = [(page, words[1:]) for page, words in FACEDIFF if words[:1] == ["fit"]]


@pytest.fixture
def workplace(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder with the files that pages have their readers write."""
    modules = set(sys.modules)
    for page in PAGES:
        text = page.read_text(encoding="utf-8")
        blocks = FENCE.findall(text)
        if name := MODULES.get(page.name):
            (tmp_path / f"{name}.py").write_text(next(block for language, block in blocks if language == "python"))
        # "`mine.yaml`:" or "In `square.yaml`, …" above a block of YAML names its file.
        for name, block in re.findall(r"`(\w+\.yaml)`[^`]*?\n\n```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL):
            (tmp_path / name).write_text(block)
    (tmp_path / "gru.yaml").write_text("class_path: gru\ninit_args: {num_layers: 2}\n")
    (tmp_path / "my_decoder.yaml").write_text("class_path: gru\n")
    (tmp_path / "hubert-base").mkdir()
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield tmp_path
    for name in {*MODULES.values()} - modules:
        sys.modules.pop(name, None)


def uses_own_code(words: Sequence[str]) -> bool:
    """Whether a command uses components of a page or of the outside project."""
    return any("outside" in word or "ThreeSpeakers" in word or "=conv" in word for word in words)


def test_the_manual_has_commands() -> None:
    assert len(FACEDIFF) > 200
    assert len(FITS) > 40


def test_commands_are_understood_by_their_parsers(workplace: Path) -> None:
    offenders = []
    for page, words in FACEDIFF:
        if {"--help", "-h"} & {*words}:
            continue
        try:
            if words[0] in VERBS:
                if not uses_own_code(words):
                    checked_words(words[0], words[1:])
                continue
            name, rest = find(words)
            if COMMANDS[name].target.partition(":")[2] not in OWN_PARSERS:
                arguments_of(load(name), f"facediff {name}", rest)
        except (FaceDiffError, SystemExit, KeyError) as error:
            if "no such f" in str(error):  # a file of the reader's, of which the parser knows the option
                continue
            offenders.append(f"{page.name}: facediff {shlex.join(words)}: {error}")
    assert offenders == []


def parse_trainings(quick: bool) -> None:
    """Parse ``facediff fit`` of pages, each distinct one once, down to the options of every component."""
    offenders, seen = [], set()
    for page, words in FITS:
        chosen = page.name in TRIED_QUICKLY or "examples" in page.parts
        key = tuple(word for word in words if "data.root" not in word)
        # A run that is not there, and help, which is printed and not parsed.
        absent = any("runs/" in word or ".help" in word or word == "--ckpt_path" for word in words)
        if chosen != quick or uses_own_code(words) or absent or key in seen:
            continue
        seen.add(key)
        try:
            parse_fit(words)
        except (FaceDiffError, SystemExit) as error:
            if "--print_config" not in words or str(error) != "0":  # which ends well
                offenders.append(f"{page.name}: facediff fit {shlex.join(words)}: {error}")
    assert offenders == []
    assert len(seen) >= 3


def test_trainings_of_tutorials_are_parsed_to_the_last_option(workplace: Path) -> None:
    parse_trainings(quick=True)


@pytest.mark.slow
def test_all_trainings_are_parsed_to_the_last_option(workplace: Path) -> None:
    parse_trainings(quick=False)


def test_tools_exist_with_their_options() -> None:
    offenders = []
    for page, words in calls("python"):
        if not words or words[0].startswith("-"):
            continue
        program = ROOT / words[0]
        if not words[0].startswith("tools/"):
            continue
        if not program.is_file():
            offenders.append(f"{page.name}: {words[0]}: no such file")
            continue
        source = program.read_text(encoding="utf-8") + "".join(
            path.read_text(encoding="utf-8") for path in program.parent.glob("*.py")
        )
        options = [word.partition("=")[0] for word in words[1:] if word.startswith("--")]
        missing = [word for word in options if f'"{word}' not in source and word[2:].replace("-", "_") not in source]
        offenders += [f"{page.name}: {words[0]}: no option {option}" for option in missing]
    assert offenders == []


def test_extras_that_are_installed_exist() -> None:
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        extra.strip()
        for page in PAGES
        for group in re.findall(r"facediff\[([\w, -]+)\]", page.read_text(encoding="utf-8"))
        for extra in group.split(",")
    }
    assert named <= extras.keys()
